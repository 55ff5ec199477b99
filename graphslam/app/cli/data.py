"""``graphslam data``: cards of recorded data sets."""

from __future__ import annotations

import typer

from graphslam.app.cli.run import JSON
from graphslam.app.cli.terminal import emit, log_to_stderr, table
from graphslam.core.errors import DataError, MissingDataError

app = typer.Typer(
    help="Recorded data sets: list, describe, download and check them.", no_args_is_help=True, rich_markup_mode=None
)


@app.command("list")
def list_data(as_json: bool = JSON) -> None:
    """List all cards, and whether their files are on this machine."""
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
    emit({"data": rows}, table(text), as_json=as_json)


@app.command()
def info(name: str, as_json: bool = JSON) -> None:
    """Show one card: contents, source, citation, licence terms and known problems."""
    from graphslam.io.cards import card

    c = card(name)
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
        "options": dict(c.options),
        "caveats": list(c.caveats),
        "bytes": c.bytes,
        "files": [f.path for f in c.files],
    }
    lines = [f"{k:14} {v}" for k, v in value.items() if k not in ("caveats", "files")]
    lines += [f"{'caveat':14} {v}" for v in c.caveats] + [f"{'file':14} {f.path} ({f.bytes} bytes)" for f in c.files]
    emit(value, "\n".join(lines), as_json=as_json)


@app.command("readers")
def list_readers(
    name: str | None = typer.Argument(None, help="Name of one reader, for its options."), as_json: bool = JSON
) -> None:
    """List what can be read, or the options of one reader."""
    from graphslam.io.readers import reader, readers

    if name is None:
        rows = [{"name": n, "reads": r.says} for n, r in readers().items()]
        emit({"readers": rows}, table(rows), as_json=as_json)
        return
    r = reader(name)
    options = [
        {"option": o.name, "type": str(o.annotation), "default": None if o.default is None else str(o.default)}
        for o in r.options().values()
    ]
    value = {"name": name, "reads": r.says, "options": options}
    emit(value, f"{name}: {r.says}\n{table(options, ['option', 'type', 'default'])}", as_json=as_json)


@app.command()
def fetch(name: str, as_json: bool = JSON) -> None:
    """Find a data set on this machine, or download it and check its checksums."""
    from graphslam.io.fetch import fetch as fetch_files

    log_to_stderr(True)
    folder = fetch_files(name, progress=not as_json)
    emit({"name": name, "folder": str(folder)}, str(folder), as_json=as_json)


@app.command()
def check(name: str, as_json: bool = JSON) -> None:
    """Compare all files with their checksums; exit with 1 if one is missing or differs."""
    from graphslam.io.catalog import check as check_files

    found = check_files(name)
    rows = [{"file": f.file.path, "state": f.state, "optional": f.file.optional} for f in found]
    emit({"name": name, "files": rows}, table(rows, ["file", "state"]), as_json=as_json)
    bad = [f for f in found if f.state != "ok" and not (f.state == "missing" and f.file.optional)]
    if bad:
        raise DataError(f"{len(bad)} of {len(found)} files are missing or differ, first {bad[0].file.path}", where=name)
