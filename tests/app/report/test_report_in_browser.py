"""The page of a run, opened and clicked in headless Chromium, at the width of a desk and of a phone."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import graphslam as gs
from graphslam.app.report.report import make_report
from graphslam.loops.ledger import LoopDecision
from tests.reference.browser import CHROMIUM, WHY_NOT, act
from tests.reference.page import Page

needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason=WHY_NOT)
LOOPS = [
    LoopDecision(
        loop=0, verdict="accepted", why="", i=1, j=5, submap_i=1, submap_j=5, chi2=2.0, weight=1.0, factor_id=9
    ),
    LoopDecision(loop=1, verdict="rejected", why="χ²", i=0, j=3, submap_i=0, submap_j=3, chi2=90.0),
]
PIXELS = """
const v = document.getElementById("view"), c = v.getContext("2d");
const hash = () => { const d = c.getImageData(0, 0, v.width, v.height).data; let h = 0;
  for (let k = 0; k < d.length; k++) h = (h * 31 + d[k]) | 0; return h; };
const colours = () => { const d = c.getImageData(0, 0, v.width, v.height).data, s = {};
  for (let k = 0; k < d.length; k += 4) if (d[k + 3] === 255) { const n = d[k] + "," + d[k + 1] + "," + d[k + 2];
    s[n] = (s[n] || 0) + 1; } return s; };
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of landmarks with GPS, every second fix withheld, and truth; and two loops in its ledger."""
    log = gs.simulate("landmark-field", preset="quick", seed=3, gps_rate=1.0, gps_sigma=0.3)
    out = tmp_path_factory.mktemp("browser") / "run"
    options = {"gps": {"use": "every-second"}, "frontend": {"particles": 20}}
    gs.run(log, seed=5, out=out, solver="batch", config=options, progress=False)
    with (out / "events.jsonl").open("a") as stream:
        stream.writelines(json.dumps(d.event()).replace("NaN", "null") + "\n" for d in LOOPS)
    return out


@pytest.fixture(scope="module")
def page(folder: Path) -> str:
    return make_report(folder).html


@needs_chromium
@pytest.mark.parametrize("width", [1280, 390])
def test_nothing_is_cut_off(page: str, tmp_path: Path, width: int) -> None:
    """No overflow of the page; what is too wide scrolls in a box of its own."""
    found = act(
        page,
        tmp_path,
        """
        const w = document.documentElement.clientWidth, out = [];
        for (const x of document.querySelectorAll("body *")) {
          if (x.closest(".wide, pre") && !x.matches(".wide, pre")) continue;
          const b = x.getBoundingClientRect();
          if (b.width > 0 && (b.right > w + 1 || b.left < -1)) out.push(x.tagName + "." + x.className);
        }
        const wide = [...document.querySelectorAll(".wide")];
        const place = (x) => document.querySelector(x).getBoundingClientRect();
        return { w, all: document.documentElement.scrollWidth, out,
          beside: place("nav").right <= place("main").left,
          scrolls: wide.filter((x) => x.scrollWidth > x.clientWidth + 1).length,
          kept: wide.every((x) => getComputedStyle(x).overflowX === "auto"),
          ms: performance.timing.domContentLoadedEventEnd - performance.timing.navigationStart };
        """,
        width=width,
    )
    assert found["w"] == width
    assert found["all"] <= width
    assert found["out"] == []
    assert found["beside"] == (width > 1000)  # the contents are a column
    assert found["kept"]
    assert width > 1000 or found["scrolls"] > 0
    assert found["ms"] < 2000


@needs_chromium
def test_layers_are_switched_and_the_map_is_zoomed(page: str, tmp_path: Path) -> None:
    found = act(
        page,
        tmp_path,
        PIXELS
        + """
        const boxes = [...document.querySelectorAll("#layers input")], out = { names: [], differ: [], back: [] };
        const begin = hash();
        for (const b of boxes) {
          const was = b.checked, before = hash();
          b.click();
          out.names.push(b.parentElement.textContent);
          out.differ.push(hash() !== before);
          b.click();
          out.back.push(hash() === before && b.checked === was);
        }
        for (const b of boxes) if (b.checked) b.click();
        out.empty = Object.keys(colours()).length < 5;
        boxes.find((b) => b.parentElement.textContent === "path").click();
        out.path = colours()["0,114,178"] || 0;
        const small = hash();
        v.dispatchEvent(new WheelEvent("wheel", { deltaY: -400, clientX: 300, clientY: 400, cancelable: true }));
        out.zoomed = hash() !== small;
        document.getElementById("fit").click();
        out.whole = hash() === small;
        return out;
        """,
    )
    names = set(found["names"])
    assert {"path", "95 % ellipses of the path", "landmarks", "95 % ellipses of landmarks", "GPS", "truth"} <= names
    assert {"dead reckoning", "loops, accepted", "loops, rejected", "true landmarks"} <= names
    differ = {n for n, d in zip(found["names"], found["differ"]) if d}
    assert differ == names
    assert all(found["back"])
    assert found["empty"]
    assert found["path"] > 100
    assert found["zoomed"]
    assert found["whole"]


@needs_chromium
def test_a_click_on_a_row_shows_that_loop(page: str, tmp_path: Path) -> None:
    found = act(
        page,
        tmp_path,
        PIXELS
        + """
        const before = hash(), rows = [...document.querySelectorAll("tr[data-loop]")];
        const out = { n: rows.length, shown: [] };
        for (const r of rows) {
          r.querySelector("td").click();
          const marked = [...document.querySelectorAll("tr.chosen")];
          out.shown.push([r.dataset.loop, v.dataset.loop, marked.length === 1 && marked[0] === r,
            colours()["240,228,66"] || 0, hash() !== before]);
        }
        const top = document.getElementById("map").getBoundingClientRect().top;
        out.seen = top > -5 && top < innerHeight;
        return out;
        """,
    )
    assert found["n"] == len(LOOPS)
    for asked, shown, marked, yellow, changed in found["shown"]:
        assert (shown, marked, changed) == (asked, True, True)
        assert yellow > 20  # the ring and the line of the chosen loop
    assert found["seen"]


@needs_chromium
def test_a_run_in_space_turns(page: str, tmp_path: Path) -> None:
    """The same layers, said to be in space: the view from the side is another, and dragging turns it."""
    found = act(
        page.replace('"dim": 2', '"dim": 3').replace(
            '<button type="button" id="fit">',
            '<button type="button" data-mode="2d">2</button><button type="button" data-mode="3d">3</button>'
            '<button type="button" id="fit">',
        ),
        tmp_path,
        PIXELS
        + """
        const flat = hash(), press = (m) => document.querySelector(`[data-mode="${m}"]`).click();
        press("3d"); const space = hash();
        v.setPointerCapture = () => {};
        const at = (type, x, y) => v.dispatchEvent(new PointerEvent(type, { pointerId: 1, clientX: x, clientY: y }));
        at("pointerdown", 300, 300); at("pointermove", 360, 320); at("pointerup", 360, 320);
        const turned = hash(); press("2d");
        return [flat !== space, space !== turned, hash() === flat];
        """,
    )
    assert found == [True, True, True]


def test_the_page_without_a_map_has_no_script(tmp_path: Path) -> None:
    """An interrupted run: nothing to draw, and no viewer."""
    (tmp_path / "config.toml").write_text('[run]\nsource = "x"\n')
    html = make_report(tmp_path).html
    Page(html).check_alone()
    assert "<script" not in html
