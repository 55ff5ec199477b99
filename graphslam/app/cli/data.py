"""``graphslam data``: recorded data sets."""

from __future__ import annotations

from pathlib import Path

import typer

from graphslam.app.cli.run import JSON, MAX_SIZE, READER, READER_OPTION, reader_options
from graphslam.app.cli.terminal import be_verbose, print_result, text_table
from graphslam.core.errors import DataError, MissingDataError
from graphslam.core.progress import Bar

app = typer.Typer(
    help="Recorded data sets: list, describe, download and check them.", no_args_is_help=True, rich_markup_mode=None
)


@app.command("list")
def list_command(as_json: bool = JSON) -> None:
    """List all data sets, and whether their files are on this machine."""
    from graphslam.io.cards import list_cards
    from graphslam.io.catalog import locate

    rows = []
    for c in list_cards():
        try:
            where = str(locate(c))
        except MissingDataError:
            where = None
        size = round(c.bytes / 1e6, 1)
        rows.append(
            {
                "name": c.name,
                "kind": c.kind,
                "mb": size,
                "here": where is not None,
                "fetchable": c.fetchable,
                "title": c.title,
            }
        )
    text = [{**r, "here": "yes" if r["here"] else "no", "fetchable": "yes" if r["fetchable"] else "no"} for r in rows]
    print_result({"data": rows}, text_table(text), as_json=as_json)


@app.command("info")
def info_command(name: str, as_json: bool = JSON) -> None:
    """Show one data set: contents, source, citation, licence terms and known problems."""
    from graphslam.io.cards import find_card

    c = find_card(name)
    value = {
        "name": c.name,
        "title": c.title,
        "kind": c.kind,
        "records": c.records,
        "source": c.source,
        "obtained_from": c.obtained_from,
        "citation": c.citation,
        "licence": c.licence,
        "terms": c.terms,
        "reader": c.reader,
        "plugin": c.plugin,
        "options": dict(c.options),
        "caveats": list(c.caveats),
        "bytes": c.bytes,
        "files": [f.path for f in c.files],
    }
    lines = [f"{k:14} {v}" for k, v in value.items() if k not in ("caveats", "files")]
    lines += [f"{'caveat':14} {v}" for v in c.caveats] + [f"{'file':14} {f.path} ({f.bytes} bytes)" for f in c.files]
    print_result(value, "\n".join(lines), as_json=as_json)


@app.command("readers")
def readers_command(
    name: str | None = typer.Argument(None, help="Name of one reader, for its options."), as_json: bool = JSON
) -> None:
    """List the readers, or the options of one reader."""
    from graphslam.io.readers import find_reader, list_readers

    if name is None:
        rows = [{"name": n, "reads": r.reads} for n, r in list_readers().items()]
        print_result({"readers": rows}, text_table(rows), as_json=as_json)
        return
    r = find_reader(name)
    options = [
        {"option": o.name, "type": str(o.annotation), "default": None if o.default is None else str(o.default)}
        for o in r.options().values()
    ]
    value = {"name": name, "reads": r.reads, "options": options}
    print_result(value, f"{name}: {r.reads}\n{text_table(options, ['option', 'type', 'default'])}", as_json=as_json)


@app.command("fetch")
def fetch_command(name: str, as_json: bool = JSON) -> None:
    """Find a data set on this machine, or download it and verify its checksums."""
    from graphslam.io.fetch import fetch_dataset as fetch_files

    if not Bar.hidden:  # --quiet
        be_verbose()
    folder = fetch_files(name, progress=not as_json)
    print_result({"name": name, "folder": str(folder)}, str(folder), as_json=as_json)


@app.command("sample")
def sample_command(
    out: Path = typer.Option(Path("sample.mcap"), "--out", "-o", help="File for the log; the true path is beside it."),
    as_json: bool = JSON,
) -> None:
    """Write a small log to try: a simulated robot with laser, wheels, IMU and GPS, as MCAP of ROS 2.

    Nothing is downloaded. Then: graphslam run sample.mcap --out runs/sample
    """
    from graphslam.app.worlds import write_sample

    bag, truth = write_sample(out)
    print_result({"log": str(bag), "truth": str(truth)}, f"{bag}\n{truth} (true path)", as_json=as_json)


@app.command("check")
def check_command(
    source: str = typer.Argument(..., help="A log: a file, a folder, or the name of a data set."),
    reader: str | None = READER,
    reader_option: list[str] = READER_OPTION,
    max_size: str | None = MAX_SIZE,
    as_json: bool = JSON,
) -> None:
    """Check a log for errors before a long run: checksums, stamps, units, signs, mountings, stuck sensors.

    Exit with 1 if there is an error.
    """
    from graphslam.app.data_check import check_source, check_summary
    from graphslam.io.cards import list_cards
    from graphslam.io.catalog import check_files as check_files

    rows, bad = [], []
    card = next((c for c in list_cards() if c.name == source), None)
    if card is not None:
        files = check_files(source)
        rows = [{"file": f.file.path, "state": f.state, "optional": f.file.optional} for f in files]
        bad = [f for f in files if f.state != "ok" and not (f.state == "missing" and f.file.optional)]
    readable = card is None or card.reader not in (None, "pose-network")
    found = [] if bad or not readable else check_source(source, reader=reader, **reader_options(reader_option))
    lines = [{"stream": n.stream, **n.finding.as_row()} for n in found]
    text = [text_table(rows, ["file", "state"])] if rows else []
    text += [f"  {n.finding.level or '-':5} {n.finding.text}" for n in found]
    text += [check_summary(found)] if found else []
    print_result({"name": source, "files": rows, "lines": lines}, "\n".join(text), as_json=as_json)
    if bad:
        raise DataError(
            f"{len(bad)} of {len(rows)} files are missing or differ, first {bad[0].file.path}", where=source
        )
    if any(n.finding.level == "bad" for n in found):
        raise typer.Exit(1)
