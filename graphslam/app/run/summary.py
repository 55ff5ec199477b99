"""The first line of a verdict: one of five results, main values, and the most important next step.

The results are *consistent*, *conservative*, *not tested*, *overconfident* and *wrong* (:func:`run_verdict`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase

from graphslam.app.verdict.chi_square import ChiSquareTest, chi_square_test, nees_tests, of_the_start
from graphslam.app.verdict.covariances import covariance_assessment
from graphslam.app.verdict.figures import RunMetrics, is_finite_number
from graphslam.app.verdict.maps import TWO_MAPS_DO
from graphslam.core.errors import DataError
from graphslam.core.findings import LEVELS, Finding, Level, worst_level
from graphslam.evaluate.covariance_assessment import LEAST_POWER, CovarianceAssessment
from graphslam.loops.ledger import ledger_of_events

START: dict[str, str] = {
    "consistent": "Consistent: errors match the covariances in all tests",
    "conservative": "Conservative: covariances are larger than the errors",
    "not tested": "Not tested: nothing in this log could have shown that the covariances are too small",
    "overconfident": "Overconfident: errors are larger than the covariances",
    "wrong": "Wrong: do not rely on this",
}
"""Start of the line for each result."""
CONSISTENCY_CODES = frozenset(
    {"chi2", "nees", "trust", "consistency-test", "correlated", "gps-correlated", "imu-contradicted", "check-points"}
)
"""Codes of findings on the size of errors. If one of them is bad, the result is overconfident; if another finding is
bad, it is wrong."""

ADVICE: dict[str, str] = {
    "folder-damaged": "copy the whole folder again, or repeat the run with --resume",
    # errors in the log come first: everything else may follow from them
    "unreadable": "give a log that can be read",
    "refused": "correct the log as the error says",
    "no-front-end": "give a log with scans, clouds or landmark observations",
    "*-missing": "give a log whose streams hold records",
    "stamps-unit": "give the time stamps in seconds",
    "no-common-time": "bring all streams onto one clock",
    "gps-clock": "bring the GPS fixes onto the clock of the other streams",
    "clock-jump": "cut the log at the jump of its clock",
    "clock-set-back": "cut the log where its stamps go back, and map the parts one by one",
    "stamps-order": "give the time stamps of the measurements, in order",
    "clocks-disagree": "correct the offset between the clocks",
    "scans-unit": "give the ranges in metres",
    "gyro-unit": "give the rates of turn in radians per second",
    "imu-gravity": "correct the unit or the mounting of the IMU",
    "bearings-degrees": "give the bearings in radians",
    "steering-degrees": "give the steering angles in radians",
    "ranges-and-path": "check the unit of the ranges",
    "ranges-constant": "remove the constant ranges from the log",
    "scans-constant": "remove the constant scans from the log",
    "scans-repeated": "keep the first of the repeated scans only",
    "scans-silent": "check the scans without a return",
    "wheels-still": "check whether the wheels are connected",
    "gps-stuck": "leave the constant GPS out (--set gps.use=none)",
    "gps-empty": "give a log with fixes, or do not ask for GPS",
    "gps-scale": "give the GPS positions in metres",
    "gps-mirrored": "correct the axes of the GPS positions or the sign of the steering",
    "imu-stuck": "leave the constant IMU out (--set imu.use=none)",
    "imu-saturated": "check the turns in which the IMU was saturated",
    "imu-axes": "correct the mounting of the IMU (T_base_imu)",
    "imu-and-path": "check the path where it turns differently from the gyro, and unit and clock of the gyro",
    "turns-disagree": "correct the unit or the mounting of the gyro",
    "odometry-leaps": "give the raw odometry, without corrections by another map",
    "heading-not-ahead": "check unit, zero and sign of the headings of the odometry",
    "observations-and-motion": "correct what the finding on the motion names",
    "scans-and-motion": "correct what the finding on the motion names",
    "distance-disagrees": "check the scale of the odometry, and unit, field of view and maximum range of the scanner",
    "turn-disagrees": "correct the turns of the odometry or the order of the beams",
    "mounting-disagrees": "measure the mounting of the scanner (T_base_sensor)",
    "*-disagrees": "correct the motion or the scans that disagree",
    "scans-of-a-map": "give each scan in the frame of its scanner, not in map coordinates",
    "scan-encoder": "subtract the offset from the encoder angles",
    "calibration-contradiction": "run `graphslam data check` to find the stream that is wrong",
    "calibration": "correct the calibration error that is named below",
    "biases": "check unit, sign and mounting of the sensor whose error is named below",
    # then what the run did with the log
    "observations-not-used": "check units, signs and ids of the observations",
    "*-not-used": "correct the cause for which a stream was not used",
    "no-effect": "leave the option out, or give a log that has its sensor",
    "front-end-idle": "leave the front end out, or check the stream that it needs",
    "state": "solve it again from this graph (`graphslam solve RUN/graph.g2o --solver lm`)",
    "refine-motion": "look for a false loop closure, or leave the refinement out (--set refine.use=false)",
    "input-better": "use the odometry path, or reduce the assumed odometry noise",
    "passes*": "look for double walls in the map, and try another seed (--seed 1)",
    "two-maps": TWO_MAPS_DO,
    "session": "check whether the sessions are of one place",
    "uneven-motion": "give the IMU of the lidar, or move it more steadily",
    "points-without-times": "give the points their times within the scan",
    "motion-uncorrected": "check the stretches that no scan corrects",
    "scans-lost": "check the stretches in which scans were dropped",
    "scans-unlike": "check the ranges, the order of the beams and the mounting, unless it is a corridor",
    "particles": "use more particles, or rbpf-ekf",
    "one-particle": "use more than one particle",
    "motion-gap": "check the pose after the gap in the motion",
    "pause-bridged": "check the map after the pause of the recording",
    "wheels-slipped": "check the wheels at these times",
    "residuals": "check units and signs of odometry and observations, or increase their noise",
    "imu-contradicted": "increase the IMU noise, or leave the IMU out (--set imu.use=none)",
    "consistency-test": "check the measurements that are named below: they contradict the others",
    "check-points-wrong": "check the row with the largest NIS, then the loop closures of the map",
    "check-points": "check the row with the largest NIS, then noise and loop closures of the map",
    "*-points-refused": "correct the rows that are refused, or leave them out",
    "control-points-*": "compare with a run without refinement (--set refine.use=false)",
    "gps-contradicts": "use the GPS fixes (--set gps.use=all) and check the new contradictions",
    "interrupted": "resume it: the same command with --resume",
    # then the covariances
    "nees": "repeat with other seeds (--seed 1, 2, …) before you use its covariances",
    "trust": "model time-correlated errors or increase the noise before you use its covariances",
    "refine-contradicted": "check the loop closures that the scans contradict (`graphslam loops RUN`)",
    "refine-two-paths": "check the map: two initial paths gave different results",
    "one-optimum": "use the method with the lowest cost",
    "beacon-not-placed": "check the distances of the beacon without a position",
    "outliers": "check the measurements that were removed as outliers",
    "gps-correlated": "set gps.bias_sigma",
    "correlated": "add time-correlated errors to the noise model",
    "refine-fixes": "set gps.bias_sigma, or a larger gps.sigma",
    "errors-last": "treat landmarks seen from one side only as less certain than reported",
    "metre": "measure one distance in the field to fix the scale",
    "place-unknown": "add a GPS fix or a known landmark",
    "imu-left-aside": "check axes, units and stamps of the IMU",
    "scans-unobservable": "check the stretches where the scans are unconstrained",
    "stream-part-used": "check why records of a stream were not used",
    "flagged": "check the submaps that the front end flags",
    "refine-scale": "check the scale of the odometry, and the field of view of the scanner",
    "refine-side": "measure the mounting of the scanner (T_base_sensor)",
    "refine-rise": "measure the mounting of the scanner (T_base_sensor)",
    "refine-widened": "increase the odometry noise as the scans show",
    "refine-*": "check the findings of the refinement",
    "calibration-*": "estimate noise and calibration from all of the log (`graphslam calibrate`)",
    "chi2": "find the factor class with the largest χ²/dof",
    "map-*": "check the findings on the fused map",
    "certificate": "try other initial values: the optimum may not be the global one",
    "mounting-unknown": "give the mounting of the scanner (mount=)",
    "records-left-out": "check why records of the log are unusable",
    "assumed": "check what was assumed because the log does not state it",
    "stamps-dense": "give the time stamps of the measurements",
}
"""Next step for a finding, by its code. Of several findings of one level the first one in this list is used: causes
come before their effects."""
JUDGED = frozenset({"chi2", "nees", "trust"})
"""Codes of findings that may be conservative."""
MARKED = frozenset({"look", "bad"})
SHORT = 90
"""Longest “To do” of a finding that is repeated in the first line, in characters."""
WORDS = {
    ("chi2", "consistent"): "residuals match the noise model",
    ("chi2", "overconfident"): "residuals larger than the noise model explains",
    ("chi2", "conservative"): "residuals smaller than the noise model expects",
    ("nees", "consistent"): "covariances match the true errors",
    ("nees", "overconfident"): "true errors are larger than the covariances",
    ("nees", "conservative"): "true errors are smaller than the covariances",
}
SMALL_RESIDUALS = "find out why residuals are small: the assumed noise is too large, or errors are time-correlated"
CONSERVATIVE = "nothing urgent; covariances are larger than needed, which only costs accuracy"
NOTHING_KNOWN = "measure some distances or points in the field (--check), to test the result"
NOTHING = "nothing; the result can be used"


def summarise_run(figures: RunMetrics, findings: Sequence[Finding]) -> Finding:
    """First line of the verdict of a run or of a merge."""
    known = _error(figures)
    chi2 = chi_square_test(figures)
    worst_nees = max(nees_tests(figures), key=lambda j: LEVELS.index(j.level), default=None)
    open_chain = "" if chi2 else "no redundant measurements"
    facts = [_made(figures), known or "true error unknown", open_chain]
    tests = [j for j in (chi2, worst_nees) if j is not None and not (j is chi2 and of_the_start(figures, chi2))]
    return headline(findings, facts, tests, known=bool(known), assessment=_with_check_points(figures))


def _with_check_points(figures: RunMetrics) -> CovarianceAssessment | None:
    """The assessment; check points replace it if it is "not tested", or if they show larger errors."""
    found, checked = covariance_assessment(figures), figures.part("check_points")
    verdict = checked.get("verdict", "wrong")  # a wrong map has its own finding
    if found is None or verdict == "wrong" or (found.verdict != "not tested" and verdict != "overconfident"):
        return found
    return replace(found, verdict=verdict, power=float(checked.get("power", 0.0)))


def run_verdict(
    findings: Iterable[Finding], tests: Sequence[ChiSquareTest], assessment: CovarianceAssessment | None
) -> tuple[str, float]:
    """One of the five results, and the power of the tests behind it (see :data:`START`).

    Parameters
    ----------
    tests : sequence of ChiSquareTest
        NEES if the log has ground truth; χ² if there is no assessment.
    assessment : CovarianceAssessment or None
        Tests without ground truth.
    """
    bad = {f.code for f in findings if f.level == "bad"}
    if bad - CONSISTENCY_CODES:
        return "wrong", 0.0
    nees = [j for j in tests if j.code == "nees"]
    used = nees or (list(tests) if assessment is None else [])
    words = {j.verdict for j in used} | ({assessment.verdict} if assessment else set())
    if bad or "overconfident" in words:
        return "overconfident", 0.0
    power = max((j.power for j in used), default=0.0)
    if "conservative" in {j.verdict for j in nees}:  # not from χ² alone: correlated errors give small residuals, too
        return "conservative", power
    if power >= LEAST_POWER and {j.verdict for j in used} == {"consistent"}:
        return "consistent", power
    return (assessment.verdict, assessment.power) if assessment else ("not tested", power)


def headline(
    findings: Iterable[Finding],
    facts: Sequence[str] = (),
    tests: Sequence[ChiSquareTest] = (),
    *,
    known: bool = True,
    assessment: CovarianceAssessment | None = None,
) -> Finding:
    """All findings in one line.

    Parameters
    ----------
    facts : sequence of str
        The result, in short phrases.
    tests : sequence of ChiSquareTest
        Ratios of the findings with the codes ``chi2`` and ``nees``.
    known : bool
        There is a reference to compare the result with.
    assessment : CovarianceAssessment or None
        Tests of the covariances without ground truth.
    """
    found = list(findings)
    worst: Level = worst_level(found) or "good"
    points = sum(f.level == worst for f in found) if worst in MARKED else 0
    verdict, power = run_verdict(found, tests, assessment)
    start = START[verdict]
    if verdict == "consistent":
        start += f" (power {min(power, 0.99):.0%} against covariances half as large as they should be)"
    if points:
        start += f"; {points} {'point' if points == 1 else 'points'} marked “{worst}”"
    summary = "; ".join([x for x in facts if x] + [consistency_line(j, found) for j in tests])
    over = {j.code for j in tests if j.verdict == "overconfident"} | (
        {"trust"} if verdict == "overconfident" else set()
    )
    do = _advice(found, over, known, verdict)
    level: Level = "" if worst == "good" and verdict == "not tested" else worst
    return Finding(level, "headline", f"{start}{' — ' + summary if summary else ''}. To do: {do}.")


def consistency_line(j: ChiSquareTest, findings: Sequence[Finding]) -> str:
    """One phrase on the consistency of the covariances, with the ratio."""
    ratio = f"{j.name} {j.ratio:.3g}"
    if j.code == "chi2" and any(f.code == "consistency-test" for f in findings):
        return f"some measurements contradict the others (all: {ratio})"
    return f"{WORDS[j.code, j.verdict]} ({ratio})"


def _advice(findings: Sequence[Finding], over: set[str], known: bool, verdict: str) -> str:
    """The most important next step."""
    level = worst_level(findings)
    if level not in MARKED:
        return NOTHING if known and verdict != "not tested" else NOTHING_KNOWN
    _, first = min(((_rank(f.code, over), f) for f in findings if f.level == level), key=lambda r: r[0])
    if first.code in JUDGED - over:
        return SMALL_RESIDUALS if first.code == "chi2" and verdict != "conservative" else CONSERVATIVE
    own = first.text.partition("To do: ")[2].rstrip(".")
    if own and len(own) <= SHORT:
        return own
    return next((do for code, do in ADVICE.items() if fnmatchcase(first.code, code)), f"check “{first.code}”")


def _rank(code: str, over: set[str]) -> int:
    """Position in the order of next steps; covariances that are too large come last."""
    if code in JUDGED - over:
        return len(ADVICE) + 1
    return next((k for k, pattern in enumerate(ADVICE) if fnmatchcase(code, pattern)), len(ADVICE))


def _made(figures: RunMetrics) -> str:
    """``305 m in 7 submaps, 4 loop closures``."""
    m = figures.metrics
    metres = m.get("path_length")
    length = length_text(float(metres)) if metres is not None and is_finite_number(metres) else ""
    if figures.sessions:
        out = [f"{len(figures.sessions)} sessions"]
    else:
        n = int(m.get("submaps", 0))
        out = [f"{length} in " * bool(length) + f"{n} submap{'s' * (n != 1)}"] if n or length else []
    if marks := int(m.get("landmarks", 0)):
        out.append(f"{marks} landmarks")
    try:
        loops = ledger_of_events(figures.events).counts().get("accepted", 0)
    except DataError:  # events of another version
        loops = 0
    if loops or not marks:
        out.append(f"{loops or 'no'} loop closure{'s' * (loops != 1)}")
    return ", ".join(out)


def _error(figures: RunMetrics) -> str:
    """``path error 4.1 cm (RMSE against ground truth)``; empty without a reference."""
    m = figures.metrics
    for key, what in (
        ("path_rmse_aligned", "path error {} (RMSE, ground truth)"),
        ("pose_rmse", "submap pose error {} (RMSE, ground truth)"),
        ("landmark_rmse_aligned", "landmark error {} (RMSE, ground truth)"),
        ("check_rmse", "{} RMSE at the check points"),
        ("gps_withheld_rmse", "{} RMSE against withheld GPS fixes"),
        ("gps_rmse", "{} RMSE against GPS fixes"),
    ):
        if is_finite_number(m.get(key)):
            return what.format(length_text(float(m[key])))
    return ""


def length_text(x: float) -> str:
    """A length with two or three digits and its unit: ``4.01 km``, ``305 m``, ``1.26 m``, ``4.1 cm``, ``6.3 mm``."""
    for least, unit, each, digits in ((1e3, "km", 1e3, 3), (1.0, "m", 1.0, 3), (0.01, "cm", 0.01, 2)):
        if x >= least:
            return f"{x / each:.{digits}g} {unit}" if x / each < 1e3 else f"{x / each:.0f} {unit}"
    return f"{1e3 * x:.2g} mm"
