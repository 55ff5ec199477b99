"""A pandas table of values that a person reads."""

from __future__ import annotations

from collections.abc import Callable

import pandas as pd


class FigureTable(pd.DataFrame):
    """A table of values that shows each with six digits: 7, not 7.000000e+00 because another one is small.

    Operations on it return a plain DataFrame.
    """

    @property
    def _constructor(self) -> Callable[..., pd.DataFrame]:
        return pd.DataFrame

    def __repr__(self) -> str:
        return str(self.to_string(float_format="{:.6g}".format))

    def _repr_html_(self) -> str:
        return str(self.to_html(float_format="{:.6g}".format))
