"""Whether anything wrong passes in silence: spoilt sessions, solved, against what was said of them.

    uv run python benchmarks/wrong_inputs.py --each 100
    uv run python benchmarks/wrong_inputs.py --clean --real ../shared/data

A short simulated session is written as a folder and one thing in it made wrong, as people do it:
a value or a line of session.toml, the calibration, the tables of the sensors. Each is checked as
`fusecap doctor` does it and solved as `fusecap solve` does. A fault counts where the motion is off,
by more than twice the error of the unspoilt session (with a floor of `FLOOR_MM` and `FLOOR_DEG`),
or a person is lost; it is noticed where something is refused or a finding says more than before.
`--clean` lists what is said of sessions in which nothing is wrong, and must be nothing.
"""

from __future__ import annotations

import argparse
import importlib.util
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from fusecap.batch.solve import solve_session
from fusecap.body.landmarks import landmark_set_named
from fusecap.body.skeleton import PAPER21
from fusecap.doctor import diagnose
from fusecap.errors import FusecapError
from fusecap.evaluate.demo_scene import demo_scene
from fusecap.evaluate.imu_noise import IMUS_13
from fusecap.evaluate.simulated_session import write_session
from fusecap.evaluate.simulator import Person, placed, simulate
from fusecap.evaluate.twin import (
    TWIN_IMU_NOISE,
    TWIN_KEYPOINT_NOISE,
    twin_sequence,
    twin_simulation,
    twin_training_sequences,
)
from fusecap.geometry.camera import Rig
from fusecap.sources.calibration_files import load_rig
from fusecap.sources.calibration_files.formats import aniposelib
from fusecap.sources.session_data import open_session
from fusecap.sources.session_file import load_session
from fusecap.stored_take import load_take
from fusecap.take import Take

SECONDS = 3.0
FLOOR_MM, FLOOR_DEG = 15.0, 6.0
"""Below twice these nothing is off: the unspoilt session errs by less on another seed."""
FOUND_SHARE = 0.8
"""Of the person-frames that the unspoilt session finds."""

Spoiler = Callable[[np.random.Generator, Path], str]


# session.toml


def _lines(path: Path) -> list[str]:
    return path.read_text().split("\n")


def _number(random: np.random.Generator, text: str) -> str:
    value = float(text)
    factors = [0.5, 0.8, 0.9, 1.1, 1.25, 2.0, -1.0, 1000.0, 0.001]
    changed = [value * factor for factor in factors] + [0.0, value + 0.1, value + 1.0, value - 0.3]
    return repr(float(random.choice([v for v in changed if v != value])))


def _list(random: np.random.Generator, text: str) -> str:
    items = [item.strip() for item in text.strip("[]").split(",")]
    match random.integers(4):
        case 0:
            index = int(random.integers(len(items)))
            items[index] = _number(random, items[index])
        case 1:
            items = items[1:] + items[:1]
        case 2:
            items = [f"{-float(item)!r}" for item in items]
        case _:
            a, b = random.choice(len(items), 2, replace=False)
            items[a], items[b] = items[b], items[a]
    return f"[{', '.join(items)}]"


_WORDS = {
    "up": ["y", "z", "-y"],
    "imu_up": ["y", "z"],
    "format": ["openpose-body25", "openpose-body25b", "csv", "xsens-mt"],
    "floor": ["true", "false"],
}


def spoil_line(random: np.random.Generator, folder: Path) -> str:
    """One line of session.toml another value, another's value, or gone."""
    path = folder / "session.toml"
    lines = _lines(path)
    keys = sorted({line.split(" = ")[0] for line in lines if " = " in line} - {"name"})
    key = str(random.choice(keys))
    rows = [i for i, line in enumerate(lines) if line.startswith(f"{key} = ")]
    row = int(random.choice(rows))
    value = lines[row].split(" = ", 1)[1]
    if random.random() < 0.15:
        told = f"without {lines[row]}"
        del lines[row]
    elif len(rows) > 1 and random.random() < 0.5:
        others = [i for i in rows if lines[i] != lines[row]]
        if not others:
            return ""
        other = int(random.choice(others))
        told = f"{lines[row]} <-> {lines[other]}"
        lines[row], lines[other] = lines[other], lines[row]
    else:
        if value.startswith("["):
            new = _list(random, value)
        elif key in _WORDS:
            choice = str(random.choice(_WORDS[key]))
            new = f'"{choice}"' if value.startswith('"') else choice
        elif value[0].isdigit() or value[0] == "-":
            new = _number(random, value)
        else:
            return ""
        told = f"{lines[row]} -> {new}"
        lines[row] = f"{key} = {new}"
    path.write_text("\n".join(lines))
    return told


def spoil_table(random: np.random.Generator, folder: Path) -> str:
    """One camera of session.toml gone, or sensors late or turned."""
    path = folder / "session.toml"
    text = path.read_text()
    tables = re.split(r"\n(?=\[\[)", text)
    match random.integers(3 if "[[subject.imu]]" in text else 1):
        case 0:
            rows = [i for i, t in enumerate(tables) if t.startswith("[[camera]]")]
            if not rows:
                return ""
            index = int(random.choice(rows))
            told = f"without {tables[index].splitlines()[:2]}"
            del tables[index]
        case 1:
            late = float(random.choice([-0.5, -0.2, 0.1, 0.3, 1.0]))
            one = str(random.choice(re.findall(r'bone = "(\w+)"', text)))
            rows = [i for i, t in enumerate(tables) if f'bone = "{one}"' in t]
            rows = rows[:1] if random.random() < 0.5 else range(len(tables))
            told = f"offset_s {late} of {one if len(rows) == 1 else 'all sensors'}"
            for i in rows:
                if tables[i].startswith("[[subject.imu]]"):
                    tables[i] = tables[i].rstrip() + f"\noffset_s = {late}\n"
        case _:
            heading = float(random.choice([-90, -30, 20, 45, 180]))
            one = str(random.choice(re.findall(r'bone = "(\w+)"', text)))
            rows = [i for i, t in enumerate(tables) if f'bone = "{one}"' in t]
            rows = rows[:1] if random.random() < 0.5 else range(len(tables))
            told = f"heading_deg {heading} of {one if len(rows) == 1 else 'all sensors'}"
            for i in rows:
                if tables[i].startswith("[[subject.imu]]"):
                    tables[i] = tables[i].rstrip() + f"\nheading_deg = {heading}\n"
    path.write_text("\n".join(tables))
    return told


# calibration.toml


def spoil_calibration(random: np.random.Generator, folder: Path) -> str:
    """One camera of the rig, or all of them."""
    path = folder / "calibration.toml"
    cameras = list(load_rig(path).cameras)
    some = [int(random.integers(len(cameras)))] if random.random() < 0.6 else range(len(cameras))
    who = cameras[some[0]].name if len(some) == 1 else "all"

    def turned(rotation: Rotation, camera: int) -> None:
        c = cameras[camera]
        matrix = rotation.as_matrix() @ c.rotation
        cameras[camera] = replace(c, rotation=matrix, translation=-matrix @ c.position_in_world)

    match random.integers(13):
        case 0:
            angle = float(random.choice([1.0, 3.0, 10.0, 30.0]))
            told = f"turned by {angle} deg"
            for i in some:
                turned(Rotation.from_rotvec(np.radians(angle) * _direction(random)), i)
        case 1:
            told = f"pictures turned by {(angle := int(random.choice([90, 180, 270])))} deg"
            for i in some:
                turned(Rotation.from_euler("z", angle, degrees=True), i)
        case 2:
            away = float(random.choice([0.05, 0.2, 1.0]))
            told = f"moved by {away} m"
            for i in some:
                c = cameras[i]
                place = c.position_in_world + away * _direction(random)
                cameras[i] = replace(c, translation=-c.rotation @ place)
        case 3:
            told = "inverse extrinsics"
            for i in some:
                c = cameras[i]
                cameras[i] = replace(
                    c, rotation=c.rotation.T, translation=c.position_in_world.copy()
                )
        case 4:
            told = f"focal length x {(factor := float(random.choice([0.5, 0.8, 0.95, 1.1, 1.5])))}"
            for i in some:
                m = cameras[i].matrix.copy()
                m[0, 0] *= factor
                m[1, 1] *= factor
                cameras[i] = replace(cameras[i], matrix=m)
        case 5:
            told = f"principal point {(off := float(random.choice([-200, -40, 40, 150])))} px off"
            for i in some:
                m = cameras[i].matrix.copy()
                m[int(random.integers(2)), 2] += off
                cameras[i] = replace(cameras[i], matrix=m)
        case 6:
            told = f"of another resolution x {(factor := float(random.choice([0.5, 2 / 3, 1.5])))}"
            for i in some:
                c = cameras[i]
                m = np.diag([factor, factor, 1.0]) @ c.matrix
                size = (round(factor * c.size_px[0]), round(factor * c.size_px[1]))
                cameras[i] = replace(c, matrix=m, size_px=size)
        case 7:
            told = f"k1 {(k1 := float(random.choice([-0.3, -0.1, 0.1, 0.3])))}"
            for i in some:
                cameras[i] = replace(cameras[i], distortion=np.array([k1, 0, 0, 0, 0]))
        case 8:
            told = f"units x {(factor := float(random.choice([0.3048, 0.8, 0.9, 1.2, 10, 1000])))}"
            who = "all"
            cameras = [replace(c, translation=factor * c.translation) for c in cameras]
        case 9:
            a, b = random.choice(len(cameras), 2, replace=False)
            who, told = f"{cameras[a].name} and {cameras[b].name}", "exchanged"
            names = cameras[a].name, cameras[b].name
            cameras[a], cameras[b] = (
                replace(cameras[a], name=names[1]),
                replace(cameras[b], name=names[0]),
            )
        case 10:
            axis, angle = str(random.choice(["x", "y", "z"])), int(random.choice([90, 180]))
            who, told = "world", f"turned by {angle} about {axis}"
            world = Rotation.from_euler(axis, angle, degrees=True).as_matrix()
            cameras = [replace(c, rotation=c.rotation @ world) for c in cameras]
        case 11:
            away = float(random.choice([-1.0, -0.3, 0.2, 0.8]))
            who, told = "world", f"{away} m higher"
            cameras = [
                replace(c, translation=c.translation - c.rotation @ [0.0, away, 0.0])
                for c in cameras
            ]
        case _:
            told = "mirrored world"
            who = "all"
            flip = np.diag([-1.0, 1.0, 1.0])
            cameras = [
                replace(
                    c,
                    rotation=flip @ c.rotation @ flip,
                    translation=flip @ c.translation,
                )
                for c in cameras
            ]
    path.write_text(aniposelib.dumps(cameras))
    return f"{who} {told}"


def _direction(random: np.random.Generator) -> np.ndarray:
    vector = random.normal(size=3)
    return vector / np.linalg.norm(vector)


# tables of sensors


def spoil_sensors(random: np.random.Generator, folder: Path) -> str:
    """One sensor's table, one person's, or everybody's."""
    files = sorted((folder / "imus").glob("*.csv"))
    some = [files[int(random.integers(len(files)))]]
    who = some[0].stem
    if random.random() < 0.4:
        who = str(random.choice(["anna", "ben"]))
        some = [file for file in files if file.stem.startswith(who)]
    kind = str(random.choice(list(TABLES)))
    if kind == "exchanged":
        other = files[int(random.integers(len(files)))]
        if other == some[0]:
            return ""
        a, b = some[0].read_text(), other.read_text()
        some[0].write_text(b)
        other.write_text(a)
        return f"{some[0].stem} and {other.stem} exchanged"
    told = ""
    state = int(random.integers(2**31))
    for file in some:
        header = file.read_text().split("\n", 1)[0]
        table = np.loadtxt(file, delimiter=",", skiprows=1)
        told, table = TABLES[kind](np.random.default_rng(state), table)
        np.savetxt(file, table, fmt="%.9f", delimiter=",", header=header, comments="")
    return f"{who} {told}"


Table = Callable[[np.random.Generator, np.ndarray], tuple[str, np.ndarray]]
Q, A, G = slice(1, 5), slice(5, 8), slice(8, 11)


def _units(random: np.random.Generator, table: np.ndarray) -> tuple[str, np.ndarray]:
    column, factor = [(A, 1 / 9.80665), (A, 9.80665), (A, 0.001), (A, 2.0), (G, np.degrees(1.0))][
        int(random.integers(5))
    ]
    table[:, column] *= factor
    return f"{'accelerometer' if column == A else 'gyroscope'} x {factor:.3f}", table


def _order(random: np.random.Generator, table: np.ndarray) -> tuple[str, np.ndarray]:
    table[:, Q] = table[:, [2, 3, 4, 1]]
    return "quaternion x y z w", table


def _inverse(random: np.random.Generator, table: np.ndarray) -> tuple[str, np.ndarray]:
    table[:, 2:5] *= -1
    return "quaternion inverse", table


def _axes(random: np.random.Generator, table: np.ndarray) -> tuple[str, np.ndarray]:
    first = int(random.choice([2, 5]))
    a, b = random.choice(3, 2, replace=False)
    table[:, [first + a, first + b]] = table[:, [first + b, first + a]]
    return f"{'quaternion' if first == 2 else 'accelerometer'} axes {a} and {b} exchanged", table


def _sign(random: np.random.Generator, table: np.ndarray) -> tuple[str, np.ndarray]:
    column = int(random.integers(2, 8))
    table[:, column] *= -1
    return f"sign of column {column}", table


def _time(random: np.random.Generator, table: np.ndarray) -> tuple[str, np.ndarray]:
    factor = float(random.choice([0.5, 0.9, 1.05, 1.2, 2.0, 1000.0]))
    table[:, 0] *= factor
    return f"times x {factor}", table


def _late(random: np.random.Generator, table: np.ndarray) -> tuple[str, np.ndarray]:
    late = float(random.choice([-1.0, -0.3, -0.1, 0.1, 0.2, 0.5, 10.0]))
    table[:, 0] += late
    return f"late by {late} s", table


def _stuck(random: np.random.Generator, table: np.ndarray) -> tuple[str, np.ndarray]:
    start = int(random.integers(0, len(table) // 2))
    table[start:, 1:] = table[start, 1:]
    return f"stuck from {table[start, 0]:.1f} s", table


def _drift(random: np.random.Generator, table: np.ndarray) -> tuple[str, np.ndarray]:
    rate = float(random.choice([2.0, 10.0, 30.0]))
    angle = np.radians(rate) * (table[:, 0] - table[0, 0])
    turned = Rotation.from_euler("y", angle[:, None]) * Rotation.from_quat(table[:, [2, 3, 4, 1]])
    table[:, Q] = turned.as_quat()[:, [3, 0, 1, 2]]
    return f"heading drifts by {rate} deg/s", table


def _world(random: np.random.Generator, table: np.ndarray) -> tuple[str, np.ndarray]:
    axis, angle = [("x", 90), ("z", 180), ("y", 90), ("y", 30)][int(random.integers(4))]
    turned = Rotation.from_euler(axis, angle, degrees=True) * Rotation.from_quat(
        table[:, [2, 3, 4, 1]]
    )
    table[:, Q] = turned.as_quat()[:, [3, 0, 1, 2]]
    return f"world turned by {angle} about {axis}", table


def _slipped(random: np.random.Generator, table: np.ndarray) -> tuple[str, np.ndarray]:
    angle = float(random.choice([15.0, 40.0, 90.0, 180.0]))
    slip = Rotation.from_rotvec(np.radians(angle) * _direction(random))
    table[:, Q] = (Rotation.from_quat(table[:, [2, 3, 4, 1]]) * slip).as_quat()[:, [3, 0, 1, 2]]
    table[:, A] = slip.inv().apply(table[:, A])
    table[:, G] = slip.inv().apply(table[:, G])
    return f"mounted {angle} deg otherwise", table


def _clipped(random: np.random.Generator, table: np.ndarray) -> tuple[str, np.ndarray]:
    table[:, A] = np.clip(table[:, A], -9.8, 9.8)
    return "accelerometer clipped at 1 g", table


def _coarse(random: np.random.Generator, table: np.ndarray) -> tuple[str, np.ndarray]:
    table[:, 1:] = np.round(table[:, 1:], 1)
    return "one decimal", table


def _gaps(random: np.random.Generator, table: np.ndarray) -> tuple[str, np.ndarray]:
    return "every second half second missing", table[(2 * table[:, 0]).astype(int) % 2 == 0]


def _renumbered(random: np.random.Generator, table: np.ndarray) -> tuple[str, np.ndarray]:
    kept = table[random.random(len(table)) > 0.2]
    kept[:, 0] = table[: len(kept), 0]
    return "a fifth of the rows missing, times numbered through", kept


def _gravity(random: np.random.Generator, table: np.ndarray) -> tuple[str, np.ndarray]:
    up = Rotation.from_quat(table[:, [2, 3, 4, 1]]).inv().apply([0.0, 9.80665, 0.0])
    table[:, A] -= up if random.random() < 0.5 else 2 * table[:, A]
    return "gravity removed or negated", table


TABLES: dict[str, Table] = {
    "units": _units,
    "order": _order,
    "inverse": _inverse,
    "axes": _axes,
    "sign": _sign,
    "time": _time,
    "late": _late,
    "stuck": _stuck,
    "drift": _drift,
    "world": _world,
    "slipped": _slipped,
    "clipped": _clipped,
    "coarse": _coarse,
    "gaps": _gaps,
    "renumbered": _renumbered,
    "gravity": _gravity,
    "exchanged": _order,
}

SPOILERS: dict[str, tuple[Spoiler, ...]] = {
    "session": (spoil_line, spoil_line, spoil_table),
    "calibration": (spoil_calibration,),
    "sensors": (spoil_sensors,),
}


# judging


@dataclass(frozen=True, kw_only=True)
class Error:
    """Of a take against the truth, of people of the same names; infinite for who is missing."""

    position_mm: np.ndarray
    """(S, B) means over the frames that both have."""
    orientation_deg: np.ndarray
    found_share: np.ndarray
    """(S,) of the true seconds."""

    def off(self, control: Error) -> bool:
        """Anybody's any bone by more than twice the control."""
        return bool(
            (self.position_mm > 2 * np.maximum(control.position_mm, FLOOR_MM)).any()
            or (self.orientation_deg > 2 * np.maximum(control.orientation_deg, FLOOR_DEG)).any()
            or (self.found_share < FOUND_SHARE * control.found_share).any()
        )

    def __str__(self) -> str:
        bone = PAPER21.bone_names[int(self.orientation_deg.max(axis=0).argmax())]
        return (
            f"[{self.position_mm.mean():.0f}, at most {self.position_mm.max():.0f} mm; "
            f"{self.orientation_deg.mean():.1f}, {bone} {self.orientation_deg.max():.0f} deg; "
            f"found {self.found_share.min():.0%}]"
        )


@dataclass(frozen=True, kw_only=True)
class Judged:
    """What came of a session."""

    error: Error | None
    """None where it was refused."""
    said: tuple[str, ...]
    fault: str = ""
    """What was raised that is no error of ours."""


def judge(folder: Path, truth: Take, *, placed: bool) -> Judged:
    """`placed`: cameras see where people are."""
    try:
        findings = diagnose(folder)
        said = tuple(str(finding) for finding in findings if finding.severity != "info")
        try:
            solved = solve_session(open_session(load_session(folder)))
        except FusecapError as error:
            return Judged(error=None, said=(*said, f"refused: {error}"))
        more = tuple(note for note in solved.report.notes if note not in said)
        return Judged(error=measure(solved.take, truth, placed=placed), said=(*said, *more))
    except Exception:
        return Judged(error=None, said=(), fault=traceback.format_exc())


def measure(take: Take, truth: Take, *, placed: bool) -> Error:
    """Per person and bone."""
    at = {round(ns / 1e6): i for i, ns in enumerate(truth.timestamps_ns.tolist())}
    rows = [(i, at.get(round(ns / 1e6), -1)) for i, ns in enumerate(take.timestamps_ns.tolist())]
    position = np.full((len(truth.subject_names), len(truth.bone_names)), np.inf)
    orientation, found = position.copy(), np.zeros(len(position))
    for true_subject, name in enumerate(truth.subject_names):
        if name not in take.subject_names:
            continue
        subject = take.subject_names.index(name)
        both = np.array([(a, b) for a, b in rows if b >= 0 and take.tracked[subject, a]], dtype=int)
        if len(both) == 0:
            continue
        x = take.bone_position_in_world_m[subject, both[:, 0]]
        y = truth.bone_position_in_world_m[true_subject, both[:, 1]]
        if not placed:
            x, y = x - x[:, :1], y - y[:, :1]
        solved = Rotation.from_matrix(
            take.bone_rotation_in_world(subject)[both[:, 0]].reshape(-1, 3, 3)
        )
        true = Rotation.from_matrix(
            truth.bone_rotation_in_world(true_subject)[both[:, 1]].reshape(-1, 3, 3)
        )
        away = (solved.inv() * true).magnitude().reshape(len(both), -1)
        position[true_subject] = 1e3 * np.linalg.norm(x - y, axis=2).mean(axis=0)
        orientation[true_subject] = np.degrees(away.mean(axis=0))
        found[true_subject] = _seconds(take, subject) / _seconds(truth, true_subject)
    return Error(position_mm=position, orientation_deg=orientation, found_share=found)


def _seconds(take: Take, subject: int) -> float:
    """For how long somebody is there; takes may have another rate than the truth."""
    return float(take.tracked[subject].sum() * np.median(np.diff(take.time_s)))


def kind_of(text: str) -> str:
    """Without its numbers: what was said of the unspoilt session too says nothing new."""
    if "samples lost" in text:  # of other sensors each time
        return text.split("samples lost")[0]
    return re.sub(r"[-+]?\d+(\.\d+)?", "#", text)


def attack(base: str, what: str, count: int, seed: int, show: bool) -> Counter[str]:
    """So many spoilt sessions of one kind."""
    outcome: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as temporary:
        clean = Path(temporary) / "clean"
        write_base(base, clean)
        truth = load_take(clean / "truth.npz")
        placed = base != "sensors"
        control = judge(clean, truth, placed=placed)
        assert control.error is not None, control
        before = {kind_of(text) for text in control.said}
        print(f"{base}, {what}: unspoilt {control.error}")
        for turn in range(count):
            random = np.random.default_rng([seed, turn])
            folder = Path(temporary) / "spoilt"
            shutil.rmtree(folder, ignore_errors=True)
            shutil.copytree(clean, folder)
            spoilers = SPOILERS[what]
            told = spoilers[int(random.integers(len(spoilers)))](random, folder)
            if not told:
                continue
            judged = judge(folder, truth, placed=placed)
            new = [text for text in judged.said if kind_of(text) not in before]
            if judged.fault:
                state = "fault"
            elif judged.error is None:
                state = "refused"
            elif judged.error.off(control.error):
                state = "told" if new else "SILENT"
            else:
                state = "harmless, told" if new else "harmless"
            outcome[state] += 1
            if show or state in ("SILENT", "fault"):
                print(f"  {turn:4} {state:8} {told}  {judged.error or ''} {judged.fault}")
                for text in new if show else ():
                    print(f"         {text}")
    noticed, missed = outcome["told"] + outcome["refused"], outcome["SILENT"] + outcome["fault"]
    share = noticed / max(noticed + missed, 1)
    print(f"  {dict(outcome)}; noticed {noticed} of {noticed + missed}: {share:.0%}", flush=True)
    return outcome


def write_base(base: str, folder: Path, seconds: float = SECONDS) -> None:
    """A session: `both`, cameras alone, or sensors alone."""
    path = write_session(demo_scene(seconds=seconds), folder)
    text = path.read_text()
    tables = re.split(r"\n(?=\[\[)", text)
    dropped = {"both": "none", "cameras": "[[subject.imu]]", "sensors": "[[camera]]"}[base]
    text = "\n".join(table for table in tables if not table.startswith(dropped))
    if base == "sensors":
        text = text.replace('calibration = "calibration.toml"\n', "")
    path.write_text(text)


ATTACKS = (
    ("both", "session"),
    ("both", "calibration"),
    ("both", "sensors"),
    ("cameras", "session"),
    ("cameras", "calibration"),
    ("sensors", "session"),
    ("sensors", "sensors"),
)


# sessions in which nothing is wrong


def clean_sessions(real: Path | None, into: Path) -> Iterator[tuple[str, Path]]:
    """Name and session file of each."""
    for base in ("both", "cameras", "sensors"):
        folder = into / f"demo-{base}"
        write_base(base, folder, seconds=6.0)
        yield f"demo, {base}", folder / "session.toml"
    for sequence in twin_training_sequences():
        for imus in (13, 6, 0):
            simulation = twin_simulation(sequence, cameras=4, imus=imus, seed=6)
            folder = into / f"{sequence.key}-{imus}"
            yield f"twin {sequence.key}, {imus} sensors", write_session(simulation, folder)
    if real is None:
        return
    gait = _script("examples/gait_imu_only.py")
    (into / "gait").mkdir()
    yield "gait", gait.write_session(real / "gait_imu_vicon", into / "gait")
    clip = _script("examples/pose2sim_clip.py")
    for trial in clip.TRIALS:
        (into / trial).mkdir()
        folder = real / "pose2sim_demo/v0.8.4_openpose_body25b"
        yield f"pose2sim {trial}", clip.write_session(folder, into / trial, trial)
    shelf = _script("benchmarks/shelf.py")
    (into / "shelf").mkdir()
    yield "shelf", shelf.write_shelf_session(real / "shelf", into / "shelf", frames=301, floor=True)
    with tarfile.open(real / "kam_two_cameras/walker1.tar.xz") as archive:
        archive.extractall(into / "kam", filter="data")
    for path in sorted((into / "kam").rglob("*.toml")):
        if "[session]" in path.read_text():
            yield f"kam {path.name}", path
    walker = into / "kam" / "walker1"
    command = [sys.executable, "-m", "fusecap", "calibrate", "imu", str(walker), "--write"]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    yield "kam session.toml, its sensors calibrated", walker / "session.toml"
    yield "caliscope", _before_caliscope(real, into / "caliscope")


def _before_caliscope(real: Path, folder: Path) -> Path:
    """Somebody simulated before its lenses, three times as far away: they stood around a desk."""
    rig = load_rig(real / "caliscope/post_optimization/camera_array.toml", up="z")
    across = [np.eye(3) - np.outer(c.rotation[2], c.rotation[2]) for c in rig.cameras]
    seen = [a @ c.position_in_world for a, c in zip(across, rig.cameras, strict=True)]
    middle = np.linalg.solve(np.sum(across, axis=0), np.sum(seen, axis=0))
    cameras = []
    for camera in rig.cameras:
        place = 3.0 * (camera.position_in_world - middle) + [0.0, 0.9, 0.0]
        cameras.append(replace(camera, translation=-camera.rotation @ place))
    sequence = twin_sequence("T2 ROM1")
    theta = placed(sequence.theta, centre_m=(0.0, 0.0))
    person = Person(name="T2", shape=sequence.shape, theta=theta, imu_bones=IMUS_13)
    simulation = simulate(
        [person],
        Rig(cameras=tuple(cameras)),
        landmark_set_named("body25"),
        rate_hz=sequence.rate_hz,
        seed=0,
        keypoint_noise=TWIN_KEYPOINT_NOISE,
        imu_noise=TWIN_IMU_NOISE,
    )
    return write_session(simulation, folder)


def _script(path: str):
    spec = importlib.util.spec_from_file_location(
        Path(path).stem, Path(__file__).resolve().parents[1] / path
    )
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def check_clean(real: Path | None) -> int:
    """What is said of sessions in which nothing is wrong."""
    alarms = 0
    with tempfile.TemporaryDirectory() as temporary:
        for name, path in clean_sessions(real, Path(temporary)):
            said = [finding for finding in diagnose(path) if finding.severity != "info"]
            alarms += len(said)
            print(f"{name}: {len(said)} findings")
            for finding in said:
                print(f"    {finding.severity} {finding}")
    return alarms


def main() -> None:
    """Every attack, or the clean sessions."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--each", type=int, default=100, help="spoilt sessions per attack")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", help="such as both/sensors")
    parser.add_argument("--show", action="store_true", help="every session, not only silent ones")
    parser.add_argument("--clean", action="store_true", help="sessions in which nothing is wrong")
    parser.add_argument("--real", type=Path, help="with --clean: the folder of real recordings")
    given = parser.parse_args()
    if given.clean:
        sys.exit(check_clean(given.real) > 0)
    started, total = time.perf_counter(), Counter()
    for base, what in ATTACKS:
        if given.only in (None, f"{base}/{what}"):
            total += attack(base, what, given.each, given.seed, given.show)
    noticed, missed = total["told"] + total["refused"], total["SILENT"] + total["fault"]
    print(
        f"all: {dict(total)}; noticed {noticed} of {noticed + missed} "
        f"({noticed / max(noticed + missed, 1):.1%}) in {time.perf_counter() - started:.0f} s"
    )
    sys.exit(0 if not total["fault"] else 1)


if __name__ == "__main__":
    main()
