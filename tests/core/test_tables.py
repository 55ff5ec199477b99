"""Tables as rows, and runs that do not load pandas."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from graphslam.core.tables import csv_text, data_frame
from graphslam.evaluate.metrics import metric_value


def test_csv_is_that_of_pandas() -> None:
    columns = ["n", "x", "text"]
    rows = [{"n": 1, "x": 0.1 + 0.2, "text": 'a, "b"'}, {"n": 2, "x": 1e-300, "text": ""}, {"n": 3, "x": np.nan}]
    assert csv_text(rows, columns) == data_frame(rows, columns).to_csv(index=False)
    assert csv_text([], columns) == "n,x,text\n"
    assert list(data_frame([], columns)) == columns


def test_an_unknown_metric_names_similar_ones() -> None:
    rows = [{"key": "nees_x", "value": 1.0}, {"key": "gap", "value": 2.0}]
    assert metric_value(rows, "gap") == 2.0
    with pytest.raises(KeyError, match="nees_x"):
        metric_value(rows, "nees")


def test_a_run_does_not_load_pandas(tmp_path) -> None:
    code = f"""
import sys
import graphslam as gs
run = gs.run(gs.simulate("landmark-field", preset="quick", seed=1), out={str(tmp_path / "r")!r}, progress=False)
run.metric("submaps"), run._repr_html_(), gs.open_run({str(tmp_path / "r")!r}).verdict
assert "pandas" not in sys.modules
print(len(run.metrics), len(run.ledger))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    rows, entries = map(int, done.stdout.split())
    assert rows > 10
    assert entries > 5
