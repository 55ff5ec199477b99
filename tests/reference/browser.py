"""Headless Chromium: a page is opened, a script acts on it as a user would, and what it found comes back."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from html import escape, unescape
from pathlib import Path
from typing import Any

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
WHY_NOT = "Chromium is not installed: the page is neither opened nor clicked here (Debian: apt-get install chromium)"
OPTIONS = ("--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--force-device-scale-factor=1")
RUN = """
window.onerror = (text) => { window.wrong = String(text); };
addEventListener("load", () => setTimeout(() => {
  let found;
  try { found = (() => { %s })(); } catch (e) { found = null; window.wrong = String(e); }
  const out = top.document.createElement("pre");
  out.id = "found";
  out.textContent = JSON.stringify({ found, wrong: window.wrong || null });
  top.document.body.append(out);
}, 200));
"""
"""Around the body of a function: it is called when the page stands, and what it returns is written beside the page."""


def act(html: str, folder: Path, script: str, *, width: int = 1280, height: int = 900, before: str = "") -> Any:
    """Open a page in a window of this size, run the body of a function in it, and return its value.

    ``before`` runs before anything of the page does. Nothing but the addition of the script and its permission is
    changed in the page; no request leaves the machine.
    """
    assert CHROMIUM is not None
    policy = re.sub(r"script-src '[^']+'", "script-src 'unsafe-inline'", html, count=1)
    inner = policy.replace("</head>", f"<script>{before}\n{RUN % script}</script></head>", 1)
    file = folder / "page.html"
    # a window is never narrower than 500 pixels; a frame is
    frame = f'<iframe style="border: 0; width: {width}px; height: {height}px" srcdoc="{escape(inner)}"></iframe>'
    file.write_text(f'<!DOCTYPE html><meta charset="utf-8"><body style="margin: 0">{frame}</body>', encoding="utf-8")
    size = [
        f"--window-size={max(width, 500)},{height}",
        f"--user-data-dir={folder / 'profile'}",
        "--virtual-time-budget=4000",
    ]
    no_network = ["--host-resolver-rules=MAP * ~NOTFOUND"]
    done = subprocess.run(
        [CHROMIUM, *OPTIONS, *size, *no_network, "--dump-dom", file.as_uri()],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    found = re.search(r'<pre id="found">(.*?)</pre>', done.stdout, re.S)
    assert found, done.stderr[-2000:]
    value = json.loads(unescape(found[1]))
    assert value["wrong"] is None, value
    return value["found"]
