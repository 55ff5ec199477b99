"""``graphslam map``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from graphslam.app.cli.run import JSON, MAX_SIZE
from graphslam.app.cli.terminal import print_result, text_table
from graphslam.core.errors import ConfigError

if TYPE_CHECKING:
    from graphslam.app.hypotheses import MinimumEntropyMap
    from graphslam.app.run.layer import Layer

CANDIDATES = (
    *("verdict", "choice", "support", "withdrawn", "submaps", "matches", "loops", "objective", "chi2", "dof"),
    *("chi2_per_dof", "entropy", "known_volume", "why"),
)


def map_command(
    run: Path = typer.Argument(..., help="Folder of a finished run of dense submaps (evidence grids or clouds)."),
    grid: bool = typer.Option(False, "--grid", help="Write also the evidence grid, map.grid.npz."),
    minimum_entropy: bool = typer.Option(
        False,
        "--minimum-entropy",
        help="Solve the run also with other subsets of its matches and loop closures. Keep the map with the lowest "
        "entropy that its graph does not contradict (clearest.*) and the next ones (alternatives/).",
    ),
    hypotheses: int = typer.Option(
        0,
        min=0,
        help="Solve the N topologies sampled by the SegSLAM particles (re-reads the log). The maps are kept as with "
        "--minimum-entropy.",
    ),
    log: str | None = typer.Option(
        None, help="With --hypotheses, --terrain, --surface: data set name or folder of the log, if it was moved."
    ),
    terrain: bool = typer.Option(
        False,
        "--terrain",
        help="Make only the terrain: where a vehicle can drive (re-reads the log along the solved path).",
    ),
    surface: bool = typer.Option(
        False, "--surface", help="Make only the surface, as PLY, GLB and OBJ (re-reads the log along the solved path)."
    ),
    voxel: float = typer.Option(0.05, help="With --surface: edge of its voxels [m]."),
    colour: str = typer.Option(
        "height", help="With --surface: height, piece (node it is attached to), session, sigma, or terrain."
    ),
    sensor_height: float | None = typer.Option(
        None, help="With --terrain: height of the scanner above the ground [m]. Default: estimated from the scans."
    ),
    low: float | None = typer.Option(
        None, help="Lower bound of the floor plans above the path [m]. Default: the value of the run."
    ),
    high: float | None = typer.Option(
        None, help="Upper bound of the floor plans above the path [m]. Default: the value of the run."
    ),
    max_size: str | None = MAX_SIZE,
    as_json: bool = JSON,
) -> None:
    """Make the fused map of a finished run again from its folder, with other options."""
    from graphslam.app.run.remake_map import remake_map

    if terrain and surface:
        raise ConfigError("--terrain and --surface exclude each other; give one of them")
    if (terrain or surface) and (grid or minimum_entropy or hypotheses):
        what = "terrain" if terrain else "surface"
        raise ConfigError(f"--{what} makes only the {what}; remove --grid, --minimum-entropy and --hypotheses")
    if terrain:
        from graphslam.app.run.terrain import Terrain

        return _make_layer(run, Terrain(sensor_height), log, as_json)
    if surface:
        from graphslam.app.run.surface import Surface
        from graphslam.maps.surface.piece import SurfaceConfig

        return _make_layer(run, Surface(SurfaceConfig(voxel=voxel), colour), log, as_json)
    made = remake_map(
        run, grid=grid, minimum_entropy=minimum_entropy, hypotheses=hypotheses, log=log, low=low, high=high,
        progress=not as_json,
    )  # fmt: skip
    value: dict[str, Any] = made.map.facts()
    rows = [{"what": k, "value": v} for k, v in value.items() if isinstance(v, (int, float)) and k != "dim"]
    text = text_table(rows)
    if made.clearest is not None:
        chosen, line = _clearest(made.clearest)
        value |= chosen
        text += f"{line}\npaths and graphs of all candidates: {run / 'alternatives'}"
        if made.clearest.left_out:
            text += f"\n{made.clearest.left_out} more candidates were not solved"
    value |= {"out": str(run), "files": [str(p) for p in made.files], "figures": [str(p) for p in made.figures]}
    value["seconds"] = {"divide": made.map.divide_s, "fuse": made.map.fuse_s}
    text += f"\n\nwritten: {', '.join(p.name for p in made.files)}; plots: {', '.join(p.name for p in made.figures)}"
    print_result(value, text, as_json=as_json)


def _clearest(found: MinimumEntropyMap) -> tuple[dict[str, Any], str]:
    """The ranked alternatives as values and as text."""
    rows, why = found.choice.rows(), found.choice.why()
    value: dict[str, Any] = {"candidates": rows, "chosen_because": why, "left_out": found.left_out}
    text = f"\n\n{text_table(rows, [c for c in CANDIDATES if c in rows[0]])}\nchosen: {why}"
    if found.choice.scale > 1.0:
        text += (
            f"\nevery χ² was divided by {found.choice.scale:.2f}, the smallest χ²/dof of the graphs with most "
            "constraints"
        )
    if found.findings:
        value["findings"] = [f.as_row() for f in found.findings]
        text += "".join(f"\nchosen map: {f.text}" for f in found.findings)
    if found.refined_map is not None:
        value["refined_entropy"] = found.refined_map.fused.entropy()
        text += f"\nentropy of the refined map: {value['refined_entropy']:.1f}"
    return value, text


def _make_layer(run: Path, layer: Layer, log: str | None, as_json: bool) -> None:
    from graphslam.app.run.layer import make_layer

    found, files, figures = make_layer(run, layer, log=log, progress=not as_json)
    facts = found.facts()
    rows = [{"what": k, "value": v} for k, v in facts.items() if isinstance(v, (int, float, str))]
    rows += [{"what": f"cells {k}", "value": v} for k, v in facts.get("cells", {}).items()]
    facts |= {"files": [str(p) for p in files], "figures": [str(p) for p in figures]}
    print_result(
        facts, f"{text_table(rows)}\n\nwritten: {', '.join(p.name for p in (*files, *figures))}", as_json=as_json
    )


COMMANDS = {"map": map_command}
