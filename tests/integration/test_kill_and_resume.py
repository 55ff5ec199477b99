"""SIGKILL at three random moments, resume, and the submaps are the same bytes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

from graphslam.app.worlds import simulate
from graphslam.io.log_store import save_log


def command(log: Path, out: Path) -> list[str]:
    options = ["--set", "frontend.particles=40", "--seed", "4", "--resume", "--json"]
    return [sys.executable, "-m", "graphslam", "run", str(log), "--out", str(out), *options]


def submap_bytes(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in sorted((folder / "submaps").iterdir())}


def test_three_kills_and_a_resume_give_the_bytes_of_an_uninterrupted_run(tmp_path):
    log = tmp_path / "log"
    save_log(simulate("landmark-field", preset="demo", seed=4), log)
    subprocess.run(command(log, tmp_path / "whole"), check=True, capture_output=True, timeout=300)
    whole = submap_bytes(tmp_path / "whole")
    rng = np.random.default_rng(11)
    out = tmp_path / "killed"
    counts = []
    for k in range(3):
        process = subprocess.Popen(command(log, out), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        # wait until it is at work on new submaps, then a random moment of the next second
        before, deadline = len(list(out.glob("submaps/*.npz"))), time.monotonic() + 120
        while process.poll() is None and len(list(out.glob("submaps/*.npz"))) <= before and time.monotonic() < deadline:
            time.sleep(0.002)
        time.sleep(float(rng.uniform(0.0, 0.03)))
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        counts.append(len(list(out.glob("submaps/*.npz"))))
        assert process.returncode == -signal.SIGKILL, f"run {k} had ended before the kill"
    assert counts == sorted(counts)
    assert 0 < counts[0] < counts[-1] < len(whole) - 1  # every run got on, none got to the end
    subprocess.run(command(log, out), check=True, capture_output=True, timeout=300)
    assert submap_bytes(out) == whole
    for name in ("landmarks.csv", "trajectory.tum", "graph.g2o", "config.toml"):
        assert (out / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
