"""What goes wrong in the machine, and not in the data, is one line and exit code 1, too."""

from __future__ import annotations

import errno
import os
import re
import resource
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from typer.testing import CliRunner

from graphslam.app import cli
from graphslam.app.cli.terminal import write_and_print
from graphslam.core.errors import FormatError, OutputError


def too_deep() -> None:
    too_deep()


def too_much() -> None:
    raise MemoryError("Unable to allocate 7.28 PiB for an array with shape (1000000000000000,)")


def no_room() -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "run/map.npz")


def no_files_left() -> None:
    raise OSError(errno.EMFILE, os.strerror(errno.EMFILE), "run/map.npz")


def forbidden() -> None:
    raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), "run/map.npz")


def a_folder() -> None:
    open("/")  # noqa: SIM115


def in_the_data() -> None:
    raise FormatError("not JSON\nat all", where="a.json")


@pytest.mark.parametrize(
    ("verb", "said"),
    [
        (
            too_deep,
            "graphslam: an input file is nested too deeply; check the input files for a damaged one",
        ),
        (too_much, "graphslam: not enough memory; .* Unable to allocate 7.28 PiB .*"),
        (
            no_room,
            "graphslam: run/map.npz: No space left on device; free disk space; .*",
        ),
        (
            no_files_left,
            "graphslam: run/map.npz: Too many open files; increase the limit of open files .*",
        ),
        (forbidden, "graphslam: run/map.npz: Permission denied"),
        (a_folder, "graphslam: /: Is a directory"),
        (in_the_data, "graphslam: a.json: not JSON at all"),
    ],
)
def test_one_line_and_exit_code_1(
    verb: Callable[[], None], said: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(cli, "app", verb)
    with pytest.raises(SystemExit) as caught:
        cli.main()
    assert caught.value.code == 1
    out, err = capfd.readouterr()
    assert out == ""
    assert len(err.splitlines()) == 1
    assert re.fullmatch(said, err.strip()), err


def verb(*args: str, stdout: int | None = subprocess.PIPE, file_size: int | None = None) -> tuple[int, str]:
    """Exit code and stderr of the real command line."""

    def limits() -> None:
        if file_size is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (file_size, file_size))

    command = [sys.executable, "-m", "graphslam", *args]
    done = subprocess.run(command, stdout=stdout, stderr=subprocess.PIPE, text=True, preexec_fn=limits, check=False)
    return done.returncode, done.stderr


def test_a_full_file_system_behind_the_output_is_one_line() -> None:
    with open("/dev/full", "w") as full:
        code, err = verb("data", "list", stdout=full.fileno())
    assert (code, err) == (
        1,
        "graphslam: No space left on device; free disk space; existing files are unchanged\n",
    )


def test_what_was_reported_before_an_error_does_not_fail_once_more() -> None:
    """Text that waits for a full disk would end the interpreter with code 120 and a second message."""
    app = "def app():\n    print('said')\n    raise MemoryError\n"
    code = f"from graphslam.app import cli\n{app}cli.app = app\ncli.main()"
    buffered = {k: v for k, v in os.environ.items() if k != "PYTHONUNBUFFERED"}
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-c", code], stdout=full, stderr=subprocess.PIPE, text=True, check=False, env=buffered
        )
    assert done.returncode == 1
    assert len(done.stderr.splitlines()) == 1


def test_a_file_that_cannot_grow_is_one_line_and_no_half_file(tmp_path: Path) -> None:
    out = tmp_path / "log"
    code, err = verb("simulate", "landmark-field", "--preset", "quick", "--out", str(out), "--json", file_size=4096)
    assert code == 1
    assert len(err.splitlines()) == 1
    assert "File too large" in err
    assert not list(out.glob(".*"))  # no temporary file is left
    assert not (out / "log.json").exists()


def run_code(code: str, **options: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, **options)  # type: ignore[call-overload,no-any-return]


@pytest.mark.parametrize(
    ("number", "code", "said"), [("SIGINT", 130, "interrupted; existing"), ("SIGTERM", 143, "terminated; existing")]
)
@pytest.mark.parametrize("how", ["raised", "hidden", "lost"])
def test_a_signal_is_one_line_also_if_a_library_hides_it(number: str, code: int, said: str, how: str) -> None:
    """Raised at once; made an ImportError of, as by an extension module; or lost in a finaliser."""
    strike = f"os.kill(os.getpid(), signal.{number}); time.sleep(0.01)"
    if how == "hidden":
        body = f"    try:\n        {strike}\n    except KeyboardInterrupt:\n        raise ImportError('failed')\n"
    elif how == "lost":
        body = f"    class F:\n        def __del__(self): {strike}\n    F()\n    time.sleep(5)\n"
    else:
        body = f"    {strike}\n"
    done = run_code(
        "import os, signal, time\nsignal.signal(signal.SIGINT, signal.default_int_handler)\n"
        f"from graphslam.app import cli\ndef app():\n{body}cli.app = app\ncli.main()"
    )
    assert (done.returncode, done.stderr) == (code, f"graphslam: {said} files are unchanged\n")


def test_an_interrupt_during_the_imports_is_one_line() -> None:
    done = run_code(
        "import os, signal, sys\nsignal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "class Finder:\n    def find_spec(self, name, *_):\n"
        "        if name == 'typer': os.kill(os.getpid(), signal.SIGINT)\n"
        "sys.meta_path.insert(0, Finder())\nfrom graphslam.__main__ import start\nstart()"
    )
    assert (done.returncode, done.stderr) == (130, "graphslam: interrupted; existing files are unchanged\n")


@pytest.mark.parametrize(
    "error",
    [
        RuntimeError("can't start new thread"),
        ImportError("libx.so: failed to map segment from shared object: Cannot allocate memory"),
        ImportError("libx.so: failed to map segment from shared object"),
        OSError(12, "Cannot allocate memory"),
        RuntimeError("std::bad_alloc"),
        SystemError("error return without exception set"),
    ],
)
def test_a_lack_of_memory_is_called_so_whoever_says_it(
    error: Exception, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    def fail() -> None:
        raise error

    monkeypatch.setattr(cli, "app", fail)
    with pytest.raises(SystemExit):
        cli.main()
    assert capfd.readouterr().err.startswith("graphslam: not enough memory; ")
    assert not cli.lacks_memory(ValueError("no such submap"))


def test_a_program_that_cannot_be_loaded_is_one_line() -> None:
    done = run_code(
        "import sys\nclass Finder:\n    def find_spec(self, name, *_):\n"
        "        if name == 'typer': raise ImportError('failed to map segment from shared object')\n"
        "sys.meta_path.insert(0, Finder())\nfrom graphslam.__main__ import start\nstart()"
    )
    assert done.returncode == 1
    assert done.stderr == (
        "graphslam: cannot be loaded: not enough memory, or a damaged installation. "
        "failed to map segment from shared object\n"
    )


def test_a_limit_of_memory_below_the_imports_is_one_line() -> None:
    """At 500 MB the import of OpenBLAS never ended."""
    done = run_code(
        "import resource\nresource.setrlimit(resource.RLIMIT_AS, (500 * 10**6,) * 2)\n"
        "from graphslam.__main__ import start\nstart()"
    )
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr == ("graphslam: not enough memory: the limit is 500 MB (ulimit -v); wanted 700 MB or more\n")


def test_the_target_of_init_is_checked_before_its_log_is_read(tmp_path: Path) -> None:
    done = CliRunner().invoke(cli.app, ["init", "no-such-log", "--out", str(tmp_path / "missing" / "a.toml")])
    assert isinstance(done.exception, OutputError)


def test_a_result_is_printed_where_its_file_cannot_be_written(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(OSError, match="No space"):
        write_and_print(no_room, {"out": "a", "x": 1}, "the result", "written to a", as_json=False)
    assert capsys.readouterr().out == "the result\n"
    with pytest.raises(OSError, match="No space"):
        write_and_print(no_room, {"out": "a", "x": 1}, "the result", "written to a", as_json=True)
    assert capsys.readouterr().out == '{"out": null, "x": 1}\n'


def test_a_closed_stdout_is_no_descriptor_of_a_file(tmp_path: Path) -> None:
    command = f'"$0" -m graphslam simulate landmark-field --preset quick --out "{tmp_path / "log"}" >&-'
    done = subprocess.run(["bash", "-c", command, sys.executable], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "log" / "log.json").is_file()
