"""One run a folder: other runs are refused while it lasts, and a dead one is in nobody's way."""

import os
import signal
import subprocess
import sys

import pytest

from torchchain.checks import FieldError
from torchchain.locks import lock

HOLDER = """
import os, sys, time
from pathlib import Path
from torchchain.locks import lock
with lock(Path(sys.argv[1]), "out"):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def other(tmp_path):
    """A process that holds the folder until it is told to end."""
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(tmp_path / "run")],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.communicate()


def test_a_folder_in_use_is_refused_in_one_line_that_names_it_and_its_holder(other, tmp_path):
    words = rf"out must be free, got .*/run, where process {other.pid} on .* is running"
    with pytest.raises(FieldError, match=words) as e, lock(tmp_path / "run", "out"):
        pass
    assert "\n" not in str(e.value)
    with lock(tmp_path / "run.1", "out"), lock(tmp_path / "ru", "out"):
        pass
    other.communicate("")
    with lock(tmp_path / "run", "out"):
        assert os.listdir(tmp_path) == [".run.lock"]
    assert os.listdir(tmp_path) == []


def test_the_lock_of_a_dead_process_is_taken_over(other, tmp_path):
    other.send_signal(signal.SIGKILL)
    other.wait()
    assert os.listdir(tmp_path) == [".run.lock"]
    with lock(tmp_path / "run", "out"):
        pass
    assert os.listdir(tmp_path) == []


def test_threads_of_one_process_meet_it_too_and_an_error_frees_it(tmp_path):
    def failing():
        with lock(tmp_path / "run", "out"):
            with pytest.raises(FieldError, match="is running"), lock(tmp_path / "run", "out"):
                pass
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        failing()
    with lock(tmp_path / "run", "out"):
        pass


def test_parents_that_were_made_for_it_go_again_unless_something_is_in_them(tmp_path):
    with lock(tmp_path / "a" / "b" / "run", "out"):
        (tmp_path / "a" / "mine").write_text("")
    assert os.listdir(tmp_path / "a") == ["mine"]


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may write anywhere")
def test_where_no_lock_can_be_written_the_run_goes_on(tmp_path):
    tmp_path.chmod(0o500)
    try:
        with lock(tmp_path / "run", "out"):
            pass
    finally:
        tmp_path.chmod(0o700)


def test_a_parent_that_is_a_file_is_left_to_those_who_write(tmp_path):
    (tmp_path / "file").write_text("")
    with lock(tmp_path / "file" / "run", "out"):
        pass
