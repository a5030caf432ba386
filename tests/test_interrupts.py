"""Ctrl-C between any two lines of a solve: what is kept is whole, a second one ends it at once."""

import os
import signal
import subprocess
import sys
import threading
from itertools import count
from pathlib import Path

import numpy as np
import pytest

import fusecap
from fusecap.batch import sorting
from fusecap.batch.assignments import Assignments
from fusecap.batch.replay import solve_as_live
from fusecap.batch.second_pass import SecondPass
from fusecap.batch.solve import SessionInstants, solve_instants
from fusecap.batch.stored_instants import StoredInstants
from fusecap.calibrate import offsets, shape
from fusecap.calibrate.cameras import people
from fusecap.calibrate.imus import session as imus
from fusecap.calibrate.sync import session as sync
from fusecap.cli import evaluate_datasets
from fusecap.evaluate import cells
from fusecap.evaluate.datasets.recording import DatasetSequence
from fusecap.interrupts import ctrl_c_held, ends_are_ctrl_c
from fusecap.recording.reader import Recording
from fusecap.setup import setup_of
from fusecap.solve import whole_motion
from fusecap.sources.session_data import open_session
from fusecap.sources.session_file import load_session
from recorded_run import record, simulated_run

SOURCE = Path(fusecap.__file__).parent


def press() -> None:
    signal.raise_signal(signal.SIGINT)


def test_ctrl_c_is_asked_for_and_then_python_s_own_again():
    with ctrl_c_held() as outer:
        assert not outer.asked
        with ctrl_c_held() as inner:
            press()
        assert inner.asked and outer.asked
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    with pytest.raises(KeyboardInterrupt):
        press()


def test_a_second_ctrl_c_ends_at_once():
    with ctrl_c_held() as stop:
        press()
        assert stop.asked
        with ctrl_c_held() as inner, pytest.raises(KeyboardInterrupt):
            press()
        assert inner is stop
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


ENDS = [signal.SIGTERM, signal.SIGHUP]


@pytest.fixture
def handled():
    """What is done by SIGTERM and SIGHUP comes back afterwards."""
    before = {number: signal.getsignal(number) for number in ENDS}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number", ENDS)
def test_a_command_is_ended_as_by_ctrl_c(number, handled):
    ends_are_ctrl_c()
    with ctrl_c_held() as stop:
        signal.raise_signal(number)
        assert stop.asked
        with pytest.raises(KeyboardInterrupt):
            press()


@pytest.mark.parametrize("number", ENDS)
def test_a_command_that_holds_nothing_is_ended_at_once(number, handled):
    ends_are_ctrl_c()
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(number)


def test_sigterm_is_ctrl_c_as_often_as_it_comes(handled):
    ends_are_ctrl_c()
    with ctrl_c_held() as stop:
        signal.raise_signal(signal.SIGTERM)
        assert stop.asked
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGTERM)
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGTERM)


def test_a_terminal_that_is_closed_is_no_second_ctrl_c(handled):
    """A shell may pass SIGHUP on when the kernel has told it; what was solved is written then."""
    ends_are_ctrl_c()
    with ctrl_c_held() as stop:
        press()
        signal.raise_signal(signal.SIGHUP)
        signal.raise_signal(signal.SIGHUP)
        assert stop.asked
    signal.raise_signal(signal.SIGHUP)


_IN_A_TERMINAL = """
import os, sys, time
os.login_tty(0)
from contextlib import nullcontext
from pathlib import Path
from fusecap import cli
from fusecap.cli.terminal import progress
from fusecap.interrupts import Interruption, ctrl_c_held

def command():
    with progress(quiet=False) as show, held() as stop:
        while not stop.asked:
            show("solving", 1, 9)
            time.sleep(0.01)
    Path(sys.argv[1]).write_text("whole")
    raise KeyboardInterrupt

held = ctrl_c_held if sys.argv[1] else lambda: nullcontext(Interruption())
cli.app = command
cli.main()
"""


@pytest.mark.skipif(not hasattr(os, "login_tty"), reason="no terminals that can be closed")
@pytest.mark.parametrize("held", [True, False])
def test_a_closed_terminal_costs_neither_the_file_nor_the_exit_code(held, tmp_path):
    master, terminal = os.openpty()
    file = tmp_path / "take"
    command = [sys.executable, "-c", _IN_A_TERMINAL, str(file) if held else ""]
    with subprocess.Popen(command, stdin=terminal) as running:
        os.close(terminal)
        shown = b""
        while b"solving" not in shown:
            shown += os.read(master, 1024)
        os.close(master)
        assert running.wait(60) == 130
    assert file.is_file() == held


def test_who_ignores_an_end_goes_on_doing_so(handled):
    """As `nohup` does."""
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    ends_are_ctrl_c()
    with ctrl_c_held() as stop:
        signal.raise_signal(signal.SIGHUP)
    signal.raise_signal(signal.SIGHUP)
    assert not stop.asked


def test_an_end_is_held_where_ctrl_c_is_ignored(handled):
    """As in a job that a shell put into the background."""
    ends_are_ctrl_c()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with ctrl_c_held() as stop:
            signal.raise_signal(signal.SIGTERM)
        assert stop.asked
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def test_an_error_leaves_python_s_own_handler():
    with pytest.raises(ValueError, match="x"), ctrl_c_held():
        raise ValueError("x")
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.parametrize("handler", [signal.SIG_IGN, lambda *_: None])
def test_who_handles_ctrl_c_otherwise_goes_on_doing_so(handler):
    signal.signal(signal.SIGINT, handler)
    try:
        with ctrl_c_held() as stop:
            press()
            assert signal.getsignal(signal.SIGINT) is handler
        assert not stop.asked
    finally:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def test_a_thread_asks_without_a_handler_of_its_own():
    told = []

    def work():
        with ctrl_c_held() as stop:
            told.append(stop.asked)

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert told == [False]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    path = folder / "run.mcap"
    with path.open("wb") as file:
        record(file, *simulated_run(folder / "session", seconds=0.3))
    return Recording(path)


class Pressing:
    """Presses Ctrl-C before the n-th line that is run in these modules of `fusecap`."""

    def __init__(self, modules, line):
        self._files = {str(SOURCE / f"{module}.py") for module in modules}
        self._line = line
        self.lines = 0

    def __enter__(self):
        sys.settrace(self._call)
        return self

    def __exit__(self, *_):
        sys.settrace(None)

    def _call(self, frame, *_):
        code = frame.f_code
        ours = code.co_filename in self._files and code.co_name not in BEFORE
        return self._each if ours else None

    def _each(self, frame, event, _):
        if event == "line":
            self.lines += 1
            if self.lines == self._line:
                signal.raise_signal(signal.SIGINT)
        return self._each


SECOND = ("batch/second_pass", "solve/whole_motion")
BEFORE = ("__init__", "__len__")
"""Where nothing is solved yet and nothing is kept."""
FIRST = ("batch/sorting", "batch/assignments")


@pytest.mark.parametrize("modules", [FIRST, SECOND], ids=["sorting", "solving"])
def test_ctrl_c_between_any_two_lines_leaves_the_first_instants_whole(run, modules, monkeypatch):
    monkeypatch.setattr(whole_motion, "PIECE", 4)
    monkeypatch.setattr(whole_motion, "AHEAD", 4)
    instants = StoredInstants(run)
    setup = instants.setup
    with Pressing(modules, line=0) as whole_run:
        whole = solve_instants(setup, instants).take
    for line in np.linspace(1, whole_run.lines, 6).astype(int):
        with Pressing(modules, line) as pressed:
            solved = solve_instants(setup, instants)
        assert pressed.lines >= line
        take, count = solved.take, len(solved.take.timestamps_ns)
        assert solved.report.interrupted == (count < len(whole.timestamps_ns)), line
        assert (take.timestamps_ns == whole.timestamps_ns[:count]).all()
        known = take.tracked & whole.tracked[: len(take.tracked), :count]
        off_m = take.theta[..., :3] - whole.theta[: len(take.theta), :count, :3]
        assert np.abs(off_m[known]).max(initial=0.0) < 0.01, line
    assert count > 12, "pressed near the end, most instants are there"


def test_ctrl_c_in_a_replay_leaves_the_first_instants(run):
    whole, _ = solve_as_live(run)

    told = count()

    def press_once(_what, done, total):
        if next(told) == 20:
            press()

    solved, _ = solve_as_live(run, progress=press_once)
    assert solved.report.interrupted
    rows = len(solved.take.timestamps_ns)
    assert 0 < rows < len(whole.take.timestamps_ns)
    assert np.array_equal(solved.take.theta, whole.take.theta[:, :rows], equal_nan=True)


@pytest.fixture
def pressing_while_sorting(monkeypatch):
    """Ctrl-C once the second instant has been sorted."""
    step, told = sorting.Pipeline.step, count()

    def pressed(*arguments):
        if next(told) == 1:
            press()
        return step(*arguments)

    monkeypatch.setattr(sorting.Pipeline, "step", pressed)


def measure_shape(data):
    setup = setup_of(data.session, data.rig, data.landmarks)
    shape.measure_bodies(setup, SessionInstants(data), heights_m={})


def check_cameras(data):
    seen = [(row, data.detections(row)) for row in range(4)]
    split = people.Split.of(data, [row for row, _ in seen])
    people._skeleton(
        people.Rounds(data=data, detections=seen, split=split, progress=None), data.rig
    )


def solve_dataset(data):
    nobody = tuple({} for _ in data.rig.cameras)
    rig, landmarks = data.rig, data.landmarks
    rate = {"rate_hz": 50.0, "frames": 4}
    DatasetSequence(name="", rig=rig, landmarks=landmarks, views=nobody, **rate).solve()


@pytest.mark.parametrize(
    "goes_on",
    [
        measure_shape,
        check_cameras,
        solve_dataset,
        offsets.calibrate_session,
        lambda data: sync._filmed_take(data.session, data.keypoints, None),
        lambda data: imus.seen_by_cameras(data.session, data),
        lambda data: evaluate_datasets.session(data.session.path),
        lambda data: cells.solve_cell(cells.TwinCell(scene="S1 FS3")),
    ],
    ids=["shape", "cameras", "dataset", "offsets", "sync", "imus", "evaluate session", "cell"],
)
def test_nobody_goes_on_with_a_part_of_a_take(goes_on, run, monkeypatch, pressing_while_sorting):
    monkeypatch.setattr(offsets, "MIN_SAMPLES", 4)
    data = open_session(load_session(run.path.with_name("session")))
    with pytest.raises(KeyboardInterrupt):
        goes_on(data)


def test_the_second_ctrl_c_ends_a_solve_in_whichever_pass_it_comes(run, pressing_while_sorting):
    solved = []

    def press_again(what, done, _total):
        if what == "solving what is sorted":
            solved.append(done)
            press()

    instants = StoredInstants(run)
    with pytest.raises(KeyboardInterrupt):
        solve_instants(instants.setup, instants, progress=press_again)
    assert solved == [1]


@pytest.mark.parametrize("asked", ["settle", "rest"])
def test_ctrl_c_after_the_last_instant_of_a_pass_leaves_a_whole_take(run, monkeypatch, asked):
    kind = {"settle": Assignments, "rest": SecondPass}[asked]
    last = getattr(kind, asked)

    def pressed(itself):
        press()
        return last(itself)

    monkeypatch.setattr(kind, asked, pressed)
    instants = StoredInstants(run)
    setup = instants.setup
    report = solve_instants(setup, instants).report
    assert report.instants == len(instants) and not report.interrupted
