"""Options of a run: front end, solver, seed, and every option with its value."""

from __future__ import annotations

import logging
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from graphslam.app.run.calibration import (
    apply_calibration,
    uses_preset_noise,
    without_noise,
)
from graphslam.app.run.choice import choose_front_end, reading_line
from graphslam.app.run.config import RunConfig
from graphslam.app.run.files import read_options
from graphslam.app.run.folder import CONFIG
from graphslam.app.run.front_ends import (
    FrontEndLike,
    check_name,
    make_front_end,
    name_of,
    named_preset,
    preset_of,
    recommended_options,
)
from graphslam.core.config import build_config, dump_toml, merge_options, options_dict
from graphslam.core.control import ControlTable, control_lines
from graphslam.core.errors import UnknownNameError
from graphslam.core.json_file import check_json
from graphslam.core.log import SensorLog
from graphslam.evaluate.stream_checks import StreamFinding
from graphslam.io.log_digest import log_digest
from graphslam.solve.registry import SOLVERS
from graphslam_frontends.base import FrontEnd

logger = logging.getLogger(__name__)
FrontEnds = FrontEndLike | Sequence[FrontEndLike]


def check_names(frontend: FrontEnds | None, solver: str) -> None:
    """Raise an error for an unknown front end or solver, before anything is read."""
    for each in frontend if isinstance(frontend, (list, tuple)) else [frontend]:
        if isinstance(each, str):
            check_name(each)
    if solver not in SOLVERS:
        raise UnknownNameError("solver", solver, SOLVERS)


def _estimates_nothing(asked: Mapping[str, Any]) -> bool:
    calibrate = asked.get("calibrate", {})
    return isinstance(calibrate, Mapping) and calibrate.get("use") == "none"


@dataclass(frozen=True)
class RunOptions:
    """Options of a run.

    Parameters
    ----------
    settings : RunConfig
    named : mapping
        Source, front end, solver, seed, the digest of the log, and the lines of control and check points.
    front : FrontEnd or None
        None if submaps come from a folder.
    asked : mapping
        Options set by the user; calibration does not change them.
    own : bool
        There is a preset for this data set.
    """

    settings: RunConfig
    named: Mapping[str, Any]
    front: FrontEnd | None = None
    asked: Mapping[str, Any] | None = None
    own: bool = False
    stored: Mapping[str, Any] | None = None

    @classmethod
    def for_log(
        cls, log: SensorLog, frontend: FrontEnds | None, solver: str, seed: int, config: Mapping[str, Any] | None
    ) -> RunOptions:
        """Front end and options for a log: defaults, overridden by the preset, overridden by the user.

        ``config["preset"]`` names another preset than that of the log; ``"none"``: defaults.
        """
        asked = dict(config or {})
        points, preset = _points_of(asked), asked.pop("preset", None)
        if isinstance(frontend, (list, tuple)) and len(frontend) < 2:
            frontend = frontend[0] if frontend else None
        why, read = "as asked for", reading_line(log)
        if read:
            logger.warning(read)
        if frontend is None:
            choice = choose_front_end(log)
            frontend, why = choice.frontend, choice.why
        name = name_of(frontend)
        suggested = recommended_options(log, name, preset)
        found, for_this_set = preset_of(log, name)
        if read:
            names = name if isinstance(name, str) else ", ".join(name)
            logger.warning("front end: %s (%s); preset: %s", names, why, preset or found or "none")
        # noise and constants of another set's preset do not fit this log: they are estimated, unless that is off
        own = bool(suggested) and (for_this_set if preset in (None, found) else _estimates_nothing(asked))
        if isinstance(frontend, FrontEnd) and not isinstance(frontend, type):
            suggested = {k: v for k, v in suggested.items() if k != "frontend"}
        if not (own and uses_preset_noise(asked)):
            suggested = without_noise(suggested, mixed=not isinstance(name, str))
        settings: RunConfig = build_config(RunConfig, merge_options(suggested, asked))
        front = make_front_end(frontend, settings.frontend)  # type: ignore[arg-type]
        named = {"source": log.name, "frontend": name, "solver": solver, "seed": seed, **points}
        return cls(settings, named, front, asked, own)

    @classmethod
    def for_records(
        cls, name: str, frontend: str, solver: str, seed: int, config: Mapping[str, Any] | None
    ) -> RunOptions:
        """Options for records that arrive later; with ``calibrate.use=auto`` nothing is estimated."""
        asked = dict(config or {})
        points = _points_of(asked)
        options = merge_options(named_preset(frontend, asked.pop("preset", None)), asked)
        settings: RunConfig = build_config(RunConfig, options)
        front = make_front_end(frontend, settings.frontend)
        if front.calibrates and settings.calibrate.given is None and settings.calibrate.use == "auto":
            settings = replace(settings, calibrate=replace(settings.calibrate, use="none"))
        named = {"source": name, "frontend": frontend, "solver": solver, "seed": seed, **points}
        return cls(settings, named, front, asked)

    @classmethod
    def of_folder(cls, root: Path) -> RunOptions:
        """Options of a run folder."""
        stored = read_options(root)
        points = {"source": str, "rows": [str]}
        names = {"source": str, "frontend": object, "solver": str, "seed": int, "control?": points, "check?": points}
        named = check_json(stored, {"run": names}, str(root / CONFIG))["run"]
        settings: RunConfig = build_config(RunConfig, {k: v for k, v in stored.items() if k != "run"})
        return cls(settings, named, stored=stored)

    @property
    def solver(self) -> str:
        """Name of the solver."""
        return str(self.named["solver"])

    def table(self, name: str) -> ControlTable | None:
        """Rows of ``control`` or ``check``; None if there are none."""
        given = self.named.get(name)
        return None if given is None else ControlTable.parse(given["source"], given["rows"])

    @property
    def with_grids(self) -> bool:
        """Are the grids of stored submaps needed?"""
        return bool(self.settings.backend.looks or self.settings.map.fuse)

    def with_digest(self, log: SensorLog) -> RunOptions:
        """With the digest of the log, which a run folder stores to recognise it."""
        return replace(self, named={**self.named, "log": log_digest(log)})

    def searching_loops(self) -> RunOptions:
        """The same options with loop search in the back end."""
        return replace(self, settings=replace(self.settings, backend=replace(self.settings.backend, loops=True)))

    def calibrated(self, log: SensorLog) -> tuple[SensorLog, RunOptions, list[StreamFinding]]:
        """The log with corrections, the options for it, and the findings."""
        assert self.front is not None
        asked = self.asked or {}
        log, applied, findings, found = apply_calibration(
            log, self.front, self.settings.calibrate, asked, own=self.own, seed=self.named["seed"]
        )
        front = self.front.with_calibration(
            log,
            asked.get("frontend", {}),
            corrected=applied.given is not None and not applied.given.neutral,
            drift=found is not None and found.kind == "clouds" and found.corrections.along_metre is not None,
        )
        options = replace(self, settings=replace(self.settings, calibrate=applied), front=front)
        return log, options, [StreamFinding("", f) for f in findings]

    def as_config(self) -> dict[str, Any]:
        """Content of ``config.toml``: names, seed, and every option with its value."""
        if self.stored is not None:
            return dict(self.stored)
        assert self.front is not None
        parts = ("backend", "gps", "imu", "compass", "beacons", "refine", "map", "calibrate")
        out = {"run": dict(self.named), "frontend": options_dict(self.front.config)}
        out |= {name: options_dict(getattr(self.settings, name)) for name in parts}
        return tomllib.loads(dump_toml(out)) if "log" in self.named else out  # the same values as read from the folder


def _points_of(asked: dict[str, Any]) -> dict[str, Any]:
    """Lines of control and check points, removed from the user's options; unreadable ones are refused."""
    given: dict[str, Any] = {name: control_lines(asked.pop(name)) for name in ("control", "check") if name in asked}
    for lines in given.values():
        ControlTable.parse(lines["source"], lines["rows"])
    return given
