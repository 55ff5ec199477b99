"""The first line of a verdict: what was made, how far it is to be trusted, and the one thing most worth doing."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from fnmatch import fnmatchcase

from graphslam.app.run.verdict import (
    TWO_MAPS_DO,
    Figures,
    Judged,
    judged_chi2,
    judged_nees,
    judged_trust,
    number,
    of_the_start,
)
from graphslam.core.errors import DataError
from graphslam.core.findings import LEVELS, Finding, Level, worst_level
from graphslam.loops.ledger import ledger_of_events

TRUST: dict[Level, str] = {
    "bad": "Do not trust this yet",
    "look": "Plausible, with open questions",
    "good": "Nothing that could be checked speaks against it",
}
"""How the line begins: by the worst finding, so that it is never greener than what stands below it."""

ADVICE: dict[str, str] = {
    # what cannot be right in the log comes first: everything else may follow from it
    "unreadable": "give a log that can be read",
    "refused": "mend what the log is refused for",
    "no-front-end": "give a log with scans, clouds or sightings",
    "*-missing": "give a log whose streams hold records",
    "stamps-unit": "give the time stamps in seconds",
    "no-common-time": "bring all streams onto one clock",
    "gps-clock": "bring the GPS fixes onto the clock of the other streams",
    "clock-jump": "cut the log at the jump of its clock",
    "stamps-order": "give the time stamps of the measurements, in order",
    "clocks-disagree": "correct the offset between the clocks",
    "scans-unit": "give the ranges in metres",
    "gyro-unit": "give the rates of turn in radians per second",
    "imu-gravity": "correct the unit or the mounting of the IMU",
    "bearings-degrees": "give the bearings in radians",
    "steering-degrees": "give the steering angles in radians",
    "ranges-and-way": "check the unit of the ranges",
    "ranges-constant": "leave the stuck ranges out of the log",
    "scans-constant": "leave the stuck scanner out of the log",
    "scans-repeated": "keep the first of the repeated scans only",
    "scans-silent": "look at the scans without a return",
    "wheels-still": "check whether the wheels are connected",
    "gps-stuck": "leave the stuck GPS out (--set gps.use=none)",
    "gps-empty": "give a log with fixes, or do not ask for GPS",
    "gps-scale": "give the GPS positions in metres",
    "gps-mirrored": "correct the axes of the GPS positions or the sign of the steering",
    "imu-stuck": "leave the stuck IMU out (--set imu.use=none)",
    "imu-saturated": "look at the turns in which the IMU was saturated",
    "imu-axes": "correct the mounting of the IMU (T_base_imu)",
    "imu-and-path": "look where the path turns otherwise than the gyro, and check unit and clock of the gyro",
    "turns-disagree": "correct the unit or the mounting of the gyro",
    "odometry-leaps": "give the raw odometry, without corrections by another map",
    "heading-not-ahead": "check unit, zero and sign of the headings of the odometry",
    "sightings-and-motion": "change what the line on the motion names",
    "scans-and-motion": "change what the line on the motion names",
    "distance-disagrees": "correct the scale of the odometry",
    "turn-disagrees": "correct the turns of the odometry or the order of the beams",
    "mounting-disagrees": "measure the mounting of the scanner (T_base_sensor)",
    "*-disagrees": "correct the motion or the scans that disagree",
    "scan-encoder": "take the offset off the angles of the encoder",
    "calibration-contradiction": "run `graphslam data check` to find the stream that is wrong",
    "calibration": "correct the error of calibration that is named below",
    "lasting": "check unit, sign and mounting of the sensor whose error is named below",
    # then what the run did with it
    "sightings-not-used": "check units, signs and identities of the sightings",
    "*-not-used": "mend why a stream was not used",
    "state": "solve it again from this graph (`graphslam solve RUN/graph.g2o --solver lm`)",
    "refine-motion": "look for a place taken for another one, or leave the refinement out (--set refine.use=false)",
    "input-better": "take the path of the odometry, or state its noise as small as it is",
    "passes*": "look where walls stand twice in the map, and try another seed (--seed 1)",
    "two-maps": TWO_MAPS_DO,
    "session": "check whether the sessions are of one place",
    "uneven-motion": "give the IMU of the lidar, or move it more steadily",
    "points-without-times": "give the points their times within the scan",
    "motion-uncorrected": "look at the stretches that no scan corrects",
    "scans-lost": "look at the stretches in which scans were lost",
    "scans-unlike": "look at the ranges, the order of the beams and the mounting",
    "particles": "use more particles, or rbpf-ekf",
    "one-particle": "use more than one particle",
    "motion-gap": "look at the place after the gap in the motion",
    "residuals": "check units and signs of wheels and sightings, or state more noise",
    "imu-contradicted": "state more noise for the IMU, or leave it out (--set imu.use=none)",
    "consistency-test": "find out why the measurements that are named below contradict the others",
    "gps-contradicts": "use the GPS fixes (--set gps.use=all) and see what then contradicts",
    "interrupted": "go on with it: the same command, with --resume",
    # then what its covariances say
    "nees": "do not rely on its covariances before other seeds say the same (--seed 1, 2, …)",
    "trust": "state the errors that last, or more noise, before its covariances are relied on",
    "refine-contradicted": "look at the loops that the scans contradict (`graphslam loops RUN`)",
    "refine-two-paths": "look at the map: two starts ended apart",
    "one-optimum": "take the method with the lowest objective",
    "beacon-not-placed": "look at the distances of the beacon without a place",
    "outliers": "look at the measurements that were taken out",
    "gps-correlated": "state gps.bias_sigma",
    "correlated": "state as noise what lasts from one residual to the next",
    "refine-fixes": "state gps.bias_sigma, or a larger gps.sigma",
    "errors-last": "take what is seen from one side only for less sure than it looks",
    "metre": "measure one distance, to tell which metre is right",
    "place-unknown": "give a fix or a landmark that says where it is",
    "imu-left-aside": "look at axes, units and stamps of the IMU",
    "scans-unheld": "look at the stretches in which nothing holds the scans",
    "stream-part-used": "look why records of a stream were not used",
    "flagged": "look at the submaps that the front end flags",
    "refine-scale": "correct the scale of the odometry",
    "refine-side": "measure the mounting of the scanner (T_base_sensor)",
    "refine-rise": "measure the mounting of the scanner (T_base_sensor)",
    "refine-widened": "state as much noise of the motion as the scans show",
    "refine-*": "look at what the refinement says",
    "calibration-*": "estimate noise and calibration from all of the log (`graphslam calibrate`)",
    "chi2": "find the kind of factor whose χ²/dof stands out",
    "map-*": "look at what is said of the fused map",
    "certificate": "try other starts: the optimum may not be the global one",
}
"""What to do about a finding, by its code; of several findings of one level the earliest in this list is the one most
worth doing, causes before what follows from them."""
JUDGED = frozenset({"chi2", "nees", "trust"})
"""Codes of lines that may err to the safe side."""
MARKED = frozenset({"look", "bad"})
SHORT = 90
"""Characters of what a finding itself says is to be done, to be said in the first line."""
WORDS = {
    ("chi2", "consistent"): "measurements consistent with each other",
    ("chi2", "over-confident"): "measurements contradict each other by more than they say",
    ("chi2", "pessimistic"): "measurements differ by less than they say",
    ("nees", "consistent"): "covariances consistent with the true errors",
    ("nees", "over-confident"): "over-confident: true errors larger than the covariances say",
    ("nees", "pessimistic"): "pessimistic: true errors smaller than the covariances say",
}
WITHOUT_TRUTH = {
    "consistent": "covariances consistent with all that the log can check",
    "over-confident": "over-confident: covariances too small for what the log holds",
    "pessimistic": "pessimistic: covariances larger than what the log holds asks for",
    "undecided": "whether its covariances are honest, the log cannot tell",
}
SMALL_RESIDUALS = "find out why residuals are smaller than stated: too much noise is stated, or errors last"
PESSIMISTIC = "nothing urgent; its covariances are larger than needed, which costs accuracy only"
NOTHING_KNOWN = "measure one distance in it, because no truth and no GPS could contradict it"
NOTHING = "nothing; it can be used as it is"


def summary(figures: Figures, findings: Sequence[Finding]) -> Finding:
    """First line of the verdict of a run or of a merge."""
    known = _error(figures)
    nees = judged_nees(figures)
    chi2, worst_nees = judged_chi2(figures), max(nees, key=lambda j: LEVELS.index(j.level), default=None)
    open_chain = "" if chi2 else "nothing in it measures twice, so that it could contradict itself"
    facts = [_made(figures), known or "true error not known", open_chain]
    trusted = judged_trust(figures)
    word = "" if trusted is None else trusted.word
    held = [] if chi2 is None or of_the_start(figures, chi2) else [chi2]
    return headline(findings, facts, [*held, *([worst_nees] if worst_nees else [])], known=bool(known), word=word)


def headline(
    findings: Iterable[Finding],
    facts: Sequence[str] = (),
    judged: Sequence[Judged] = (),
    *,
    known: bool = True,
    word: str = "",
) -> Finding:
    """What all findings together say, as one line.

    Parameters
    ----------
    facts : sequence of str
        What was made, in a few words each.
    judged : sequence of Judged
        What the covariances were held against: the figures of findings with the codes ``chi2`` and ``nees``.
    known : bool
        Is there anything that the result could be held against?
    word : str
        On the covariances, by what the log itself holds
        (:func:`graphslam.evaluate.covariance_assessment.assess_covariances`).
    """
    found = list(findings)
    level = worst_level(found) or "good"
    points = sum(f.level == level for f in found) if level in MARKED else 0
    marked = f" ({points} {'point' if points == 1 else 'points'} marked “{level}”)" if points else ""
    held = [consistency(j, found) for j in judged]
    by_truth = any(j.code == "nees" for j in judged)  # then what the log says of itself matters less
    if word and not (by_truth and word != "over-confident"):
        held.append(WITHOUT_TRUTH[word])
    said = "; ".join([x for x in facts if x] + held)
    over = {j.code for j in judged if j.said == "over-confident"} | ({"trust"} if word == "over-confident" else set())
    do = _advice(found, over, known, word)
    return Finding(level, "headline", f"{TRUST[level]}{marked}{': ' + said if said else ''}. To do: {do}.")


def consistency(j: Judged, findings: Sequence[Finding]) -> str:
    """Are the covariances honest, and held against what?"""
    ratio = f"{j.name} {j.ratio:.3g}"
    if j.code == "chi2" and any(f.code == "consistency-test" for f in findings):
        return f"some measurements contradict the others (all together {ratio})"
    return f"{WORDS[j.code, j.said]} ({ratio})"


def _advice(findings: Sequence[Finding], over: set[str], known: bool, word: str) -> str:
    """The one thing most worth doing."""
    level = worst_level(findings)
    if level not in MARKED:
        return NOTHING if known else NOTHING_KNOWN
    _, first = min(((_rank(f.code, over), f) for f in findings if f.level == level), key=lambda r: r[0])
    if first.code in JUDGED - over:
        return SMALL_RESIDUALS if first.code == "chi2" and word != "pessimistic" else PESSIMISTIC
    own = first.text.partition("To do: ")[2].rstrip(".")
    if own and len(own) <= SHORT:
        return own
    return next((do for code, do in ADVICE.items() if fnmatchcase(first.code, code)), f"look at “{first.code}”")


def _rank(code: str, over: set[str]) -> int:
    """Place in the order of what is worth doing; covariances that are too large are worth the least."""
    if code in JUDGED - over:
        return len(ADVICE) + 1
    return next((k for k, pattern in enumerate(ADVICE) if fnmatchcase(code, pattern)), len(ADVICE))


def _made(figures: Figures) -> str:
    """``305 m in 7 submaps, 4 loops closed``."""
    m = figures.metrics
    way = m.get("path_length")
    length = in_metres(float(way)) if way is not None and number(way) else ""
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
        out.append(f"{loops or 'no'} loop{'s' * (loops != 1 and loops != 0)} closed")
    return ", ".join(out)


def _error(figures: Figures) -> str:
    """``4.1 cm from the truth``; empty where nothing is known that the map was held against."""
    m = figures.metrics
    for key, what in (
        ("path_rmse_aligned", "path {} from the truth"),
        ("pose_rmse", "ends of submaps {} from the truth"),
        ("landmark_rmse_aligned", "landmarks {} from the truth"),
        ("gps_withheld_rmse", "{} from the withheld GPS fixes"),
        ("gps_rmse", "{} from the GPS fixes"),
    ):
        if number(m.get(key)):
            return what.format(in_metres(float(m[key])))
    return ""


def in_metres(x: float) -> str:
    """A length in words: ``4.01 km``, ``305 m``, ``1.26 m``, ``4.1 cm``, ``6.3 mm``."""
    for least, unit, each, digits in ((1e3, "km", 1e3, 3), (1.0, "m", 1.0, 3), (0.01, "cm", 0.01, 2)):
        if x >= least:
            return f"{x / each:.{digits}g} {unit}" if x / each < 1e3 else f"{x / each:.0f} {unit}"
    return f"{1e3 * x:.2g} mm"
