"""Is the graph solved, and do front end and IMU agree with it?"""

from __future__ import annotations

from collections.abc import Mapping

from graphslam.app.verdict.figures import CERTAIN, RunMetrics, is_finite_number
from graphslam.core.findings import Finding
from graphslam.evaluate.intervals import by_chance

SMALL_GAP = 1e-6
"""Relative gap of the objective above the batch optimum that counts as zero."""
FLAGGED = 0.05
"""Probability that the front end flags a submap of a consistent run."""


def check_solved(figures: RunMetrics) -> list[Finding]:
    """Is the solution at the optimum?"""
    m = figures.metrics
    converged = figures.report.get("converged", m.get("converged"))
    if converged is None:
        text = "solution: unknown — the run folder does not record whether the solver converged."
        return [Finding("bad", "state", text)]
    if not converged:
        return [Finding("bad", "state", "solution: not converged — the graph is not at its optimum.")]
    objective, gap = m.get("objective", m.get("join_chi2")), m.get("gap")
    value = "at the optimum" if objective is None else f"cost {objective:.6g} (Σ rᵀ P⁻¹ r)"
    if gap is None:
        text = f"solution: {value} — converged by the solver's own test; not compared with a batch solution."
        return [Finding("good", "state", text)]
    scale = max(abs(objective or 0.0), 1.0)
    small = gap <= SMALL_GAP * scale
    text = "a batch solution from there is no lower" if small else f"a batch solution from there is lower by {gap:.3g}"
    return [Finding("good" if small else "look", "state", f"solution: {value} — converged; {text}.")]


def check_certificate(figures: RunMetrics) -> list[Finding]:
    """Is the optimum the global one?"""
    found = figures.report.get("certificate")
    if found is None:
        text = "global optimum: not tested — no certificate was requested."
        return [Finding("", "certificate", text)]
    text = str(found.get("verdict", found) if isinstance(found, Mapping) else found)
    return [Finding("good" if text.startswith("certified") else "look", "certificate", f"global optimum: {text}")]


def check_flagged(figures: RunMetrics) -> list[Finding]:
    """Does the front end flag more submaps than expected by chance?"""
    counts = figures.part("flagged_submaps")
    flagged, n = counts.get("any", 0), figures.metrics.get("submaps", 0.0)
    if not (is_finite_number(flagged) and flagged):
        return []
    why = ", ".join(f"{v:g} for {k}" for k, v in counts.items() if k != "any" and is_finite_number(v))
    text = f"submaps flagged by the front end: {flagged:g} of {n:g} ({why})"
    usual = by_chance(int(n), FLAGGED, CERTAIN)
    if flagged <= usual:
        return [Finding("", "flagged", f"{text} [≤ {usual:g} by chance] — no more than chance.")]
    return [Finding("look", "flagged", f"{text} [≤ {usual:g} by chance] — more than chance.")]


def check_imu_path(figures: RunMetrics) -> list[Finding]:
    """Do the axes and angular rates of the IMUs agree with the path?"""
    out: list[Finding] = []
    for e in figures.events:
        if e.get("event") == "imu-axes" and e.get("verdict") == "wrong":
            out.append(Finding("bad", "imu-axes", f"IMU {e.get('stream')}: {e.get('words')}"))
        if e.get("event") == "imu-axes" and e.get("verdict") == "unlike":
            moved, missed = e["turns"]
            text = (
                f"IMU {e.get('stream')}: yaw rates of path and gyro differ by {missed:.2g} rad/s (gyro: {moved:.2g} "
                "rad/s) for any mounting — the path is wrong, or unit or clock of the gyro is."
            )
            out.append(Finding("bad", "imu-and-path", text))
        if e.get("event") == "imu-axes" and e.get("verdict") == "not checked":
            text = f"IMU {e.get('stream')}, axes: not tested — {e.get('why')}."
            out.append(Finding("", "imu-axes", text))
        if e.get("event") == "imu-contradicted":
            text = f"IMU {e.get('stream', '')}".strip()
            line = f"{text}: contradicts the submaps — the assumed noise of one of them is too small."
            out.append(Finding("bad", "imu-contradicted", line))
    return out
