"""Randomly edit robots and logs of every format: each must be read, or refused in one sentence, within a time limit.

python experiments/benchmarks/fuzz_logs.py [EDITS] [SEED] [FORMAT]

An edit changes bytes of a file (replace, delete, add, duplicate, move) or its content: cells, lines and numbers of
texts, values of JSON and YAML, arrays of npz, columns of parquet, whole files. Failures are printed with their seed.
"""

import argparse
import io
import json
import logging
import lzma
import resource
import shutil
import signal
import sys
import tempfile
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "rollout"))

import contextlib

import foreign_logs

from op3.report.robot_table import robot_table
from op3.robot.data_file import DataFileError
from op3.robot.robot import Robot
from op3.rollout import LogError, Metadata, Recorder, Rollout, read_episodes
from op3.rollout.proposal import as_yaml, propose

LONGEST, MEMORY = 20.0, 6 << 30
"""Limits of an edit: processor time [s] and address space [B]."""

ODD = ["0", "-1", "1", "2", "1e5", "1e-300", "1e308", "1e999", "nan", "-inf", "0x10", "1_0", "1,5", "9" * 400]
ODD += ["true", "null", "~", "-", "é", "[]", "{}", "[[", '"', ";", "\t", " ", ""]
VALUES: list[Any] = [
    None,
    True,
    "",
    "x",
    "nan",
    0,
    -1,
    7,
    1e300,
    -1e-300,
    10**30,
    float("nan"),
    float("inf"),
    [],
    {},
    [[]],
    [1, "a"],
]

Files = dict[str, bytes]
Random = np.random.Generator


def rollout() -> Rollout:
    """The motion as a log in op3's format."""
    arrays = {
        "time": foreign_logs.TIME,
        "joint/position": foreign_logs.position(),
        "joint/velocity": foreign_logs.velocity(),
        "command/position": foreign_logs.target(),
    }
    return Rollout.from_arrays(arrays, Metadata(foreign_logs.JOINTS, "real", "stand", foreign_logs.RATE))


def wide_csv(folder: Path) -> Path:
    """A wide CSV and its sidecar."""
    return rollout().to_csv(folder / "run.csv")


def saved(folder: Path) -> Path:
    """A rollout folder."""
    return rollout().save(folder / "run")


def interrupted(folder: Path) -> Path:
    """The files of an interrupted recorder."""
    log = rollout()
    recorder = Recorder(folder / "run", log.metadata)
    for row in range(log.rows):
        recorder.append({key: log.array(key)[row] for key in log.channels})
    recorder.abandon()
    return folder / "run"


def servo_bench(folder: Path) -> Path:
    """A compressed recording of one servo with a pendulum."""
    rows = zip(
        foreign_logs.TIME.tolist(),
        foreign_logs.position()[:, 0].tolist(),
        foreign_logs.velocity()[:, 0].tolist(),
        foreign_logs.target()[:, 0].tolist(),
        strict=True,
    )
    more = dict(load=10, input_volts=7.4, temp=30, torque_enable=True)
    entries = [dict(more, timestamp=t, position=q, speed=w, goal_position=goal) for t, q, w, goal in rows]
    header = dict(mass=0.5, length=0.1, kp=200, vin=7.4, motor="xl330", trajectory="sin_sin", entries=entries)
    path = folder / "2026-01-15_10h28m10.json.xz"
    path.write_bytes(lzma.compress(json.dumps(header).encode()))
    return path


def robot(folder: Path) -> Path:
    """A robot file and its model, with a joint of every kind."""
    geom = '<geom type="capsule" fromto="0 0 0 0 0 0.1" size="0.01" mass="0.1"/>'
    joints = {"shoulder": "", "elbow": 'damping="0.1"', "finger": 'type="slide"', "flap": 'stiffness="0.1"'}
    inner = ""
    for name, more in reversed(joints.items()):
        joint = f'<joint name="{name}" axis="0 1 0" range="-1 1" {more}/>'
        inner = f'<body name="{name}_link" pos="0 0 0.1">{joint}{geom}{inner}</body>'
    options = '<compiler angle="radian"/><actuator><position joint="elbow" kp="5"/></actuator>'
    mjcf = f'<mujoco model="arm">{options}<worldbody><body name="base">{geom}{inner}</body></worldbody></mujoco>'
    (folder / "arm.xml").write_text(mjcf)
    entries = "shoulder: {bus_id: 1, home: 0.1}, elbow: {bus_id: 2, limits: [-0.9, 0.9]}, "
    entries += "finger: {bus_id: 3, travel: 0.5}, flap: {passive: true}"
    head = "format: op3-robot/1\nname: arm\nmodel: arm.xml\nbase: base\nfixed: true\nservo: xm430-w350\n"
    (folder / "arm.yaml").write_text(f"{head}joints: {{{entries}}}\nposes: {{up: {{elbow: 0.5}}}}\n")
    return folder / "arm.yaml"


OURS = {"wide csv": wide_csv, "folder": saved, "interrupted": interrupted, "servo bench": servo_bench, "mjcf": robot}
"""op3's formats, and the format of one servo."""


def bytes_edit(raw: bytes, random: Random) -> bytes:
    """Replace, delete, add, duplicate, move or zero some bytes."""
    start, size = int(random.integers(len(raw) + 1)), int(random.choice([0, 1, 1, 4, 40, 1000, len(raw)]))
    end, new = min(len(raw), start + size), random.bytes(int(random.choice([0, 1, 1, 4, 12])))
    match int(random.integers(5)):
        case 0:
            return raw[:start] + bytes(end - start) + raw[end:]
        case 1:
            return raw[:end] + raw[start:]
        case 2:
            return raw[end:] + raw[:end]
    return raw[:start] + new + raw[end:]


def text_edit(raw: bytes, random: Random) -> bytes:
    """Change, delete or duplicate a cell, line or column of a text, its separators or its byte-order mark."""
    lines = raw.decode("utf-8", "replace").split("\n")
    at, other = (int(i) for i in random.integers(len(lines), size=2))
    match int(random.integers(7)):
        case 0:
            del lines[at]
        case 1:
            lines.insert(at, lines[other])
        case 2:
            lines[at], lines[other] = lines[other], lines[at]
        case 3:
            mark = str(random.choice([",", ":", " ", "."]))
            cells = lines[at].split(mark)
            cells[int(random.integers(len(cells)))] = str(random.choice(ODD))
            lines[at] = mark.join(cells)
        case 4:
            column = int(random.integers(12))
            rows = [line.split(",") for line in lines]
            lines = [
                ",".join(c[:column] + [str(random.choice(ODD))] * int(random.integers(3)) + c[column + 1 :])
                for c in rows
            ]
        case 5:
            old, new = (str(x) for x in random.choice([",", ".", ";", "\t", "\n", "e", " ", '"', ":", "0"], 2))
            return raw.decode("utf-8", "replace").replace(old, new, int(random.choice([1, 9, -1]))).encode()
        case 6:
            encoding = str(random.choice(["utf-8-sig", "utf-16", "latin-1", "utf-7"]))
            return "\n".join(lines).encode(encoding, "replace")
    return "\n".join(lines).encode()


def value_edit(value: Any, random: Random) -> Any:
    """Change, delete, rename or duplicate one value in nested lists and mappings."""
    if not isinstance(value, list | dict) or not value or random.random() < 0.15:
        return VALUES[int(random.integers(len(VALUES)))]
    key = list(value)[int(random.integers(len(value)))] if isinstance(value, dict) else int(random.integers(len(value)))
    changed = value.copy()
    if random.random() < 0.15:
        del changed[key]
    elif random.random() < 0.1 and isinstance(changed, dict):
        changed[str(random.choice([*"abc", "", "position", "joints"]))] = changed.pop(key)
    else:
        changed[key] = value_edit(value[key], random)
    return changed


def json_edit(raw: bytes, random: Random) -> bytes:
    """Edit a value of a JSON file."""
    return json.dumps(value_edit(json.loads(raw), random)).encode()


def array_edit(array: np.ndarray, random: Random) -> np.ndarray:
    """Change the type, shape, order or some numbers of an array."""
    match int(random.integers(7)):
        case 0:
            return array.astype(str(random.choice(["f2", ">f8", "i1", "u8", "?", "c16", "U5", "S3", "M8[ns]"])))
        case 1:
            return array[: int(random.integers(len(array) + 1))] if array.ndim else array
        case 2:
            return array.reshape(-1) if random.random() < 0.5 else array[..., None]
        case 3:
            return array.T
        case 4:
            return np.concatenate([array, array]) if array.ndim else array
        case 5:
            return random.permutation(array) if array.ndim else array
    if array.dtype.kind == "f" and array.size:
        array = array.copy()
        array.flat[int(random.integers(array.size))] = random.choice([np.nan, np.inf, 1e300, -1e9, 0.0])
    return array


def npz_edit(raw: bytes, random: Random) -> bytes:
    """Edit an array of an archive."""
    with np.load(io.BytesIO(raw)) as archive:
        content = {name: archive[name] for name in archive.files}
    name = str(random.choice(sorted(content)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        content[name] = array_edit(content[name], random)
    if random.random() < 0.2:
        content[str(random.choice(["time", "x", "joints", "é", "data"]))] = content.pop(name)
    stream = io.BytesIO()
    np.savez(stream, **content)
    return stream.getvalue()


def parquet_edit(raw: bytes, random: Random) -> bytes:
    """Change the values or the type of a table's column, rename it, or delete it."""
    import pyarrow
    from pyarrow import parquet

    table = parquet.read_table(io.BytesIO(raw)).to_pydict()
    name = str(random.choice(sorted(table)))
    column = value_edit(table[name], random)
    if random.random() < 0.1:
        del table[name]
    elif isinstance(column, list):
        table[name] = [*column, *column][: len(table[name])]
    stream = io.BytesIO()
    parquet.write_table(pyarrow.table(table), stream)
    return stream.getvalue()


def whole_edit(files: Files, random: Random) -> Files:
    """Empty, delete, replace or compress a file."""
    names = sorted(files)
    one, other = (str(name) for name in random.choice(names, 2))
    match int(random.integers(4)):
        case 0:
            return {**files, one: b""}
        case 1:
            return {name: raw for name, raw in files.items() if name != one}
        case 2:
            return {**files, one: files[other]}
    return {**files, one: lzma.compress(files[one])}


def edit(files: Files, random: Random) -> Files:
    """One random edit of a log's files."""
    if random.random() < 0.05:
        return whole_edit(files, random)
    name = str(random.choice(sorted(files)))
    raw, kind, packed = files[name], Path(name).suffix, name.endswith(".xz")
    try:
        if packed and random.random() < 0.8:
            raw, kind = lzma.decompress(raw), Path(name).with_suffix("").suffix
    except lzma.LZMAError:
        pass
    means: list[Callable[[bytes, Random], bytes]] = [bytes_edit]
    means += [text_edit] * 3 if kind in (".csv", ".yaml", ".txt", ".json", ".xml") else []
    means += {".json": [json_edit] * 3, ".npz": [npz_edit] * 3, ".parquet": [parquet_edit] * 3}.get(kind, [])
    try:
        changed = means[int(random.integers(len(means)))](raw, random)
    except Exception:  # an edit before has damaged the file so that what it says cannot be edited
        changed = bytes_edit(raw, random)
    return {**files, name: lzma.compress(changed) if packed and raw is not files[name] else changed}


class Slow(BaseException):
    """The time for one edit is over."""


def too_slow(*_: Any) -> None:
    """End an edit that exceeds the time limit."""
    raise Slow


def outcome(path: Path) -> str:
    """Result of reading, `read` or `refused`; any other error is raised."""
    if path.name == "arm.yaml":
        try:
            robot_table(Robot(path))
        except DataFileError as error:
            if "\n" in str(error):
                raise AssertionError(f"not one sentence: {error}") from None
            return "refused"
        return "read"
    try:
        logs = read_episodes(path)
    except LogError as error:
        if "\n" in str(error) or len(str(error)) > 1200:
            raise AssertionError(f"not one sentence: {error}") from None
        return "refused"
    finally:
        with contextlib.suppress(LogError):
            as_yaml(*propose(path))
    for number, log in enumerate(logs[:2]):
        log.save(path.parent / f"saved_{number}")
    return "read"


def main(edits: int, seed: int, only: str = "") -> int:
    """Try this number of edits, print the results, and return how many failed."""
    logging.disable()
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    warnings.simplefilter("error", RuntimeWarning)
    signal.signal(signal.SIGPROF, too_slow)
    foreign_logs.TIME = foreign_logs.TIME[:60]
    formats = {n: make for n, make in {**foreign_logs.FORMATS, **OURS}.items() if only in n}
    ends: dict[str, Counter[str]] = {name: Counter() for name in formats}
    sound: dict[str, tuple[Path, Files]] = {}
    place = Path(tempfile.mkdtemp(prefix="fuzz_logs_"))
    for name, make in formats.items():
        folder = place / name
        folder.mkdir()
        path = make(folder)
        content = {str(f.relative_to(folder)): f.read_bytes() for f in folder.rglob("*") if f.is_file()}
        sound[name] = path.relative_to(folder), content
        shutil.rmtree(folder)
    for number in tqdm(range(edits), unit="edit", mininterval=10.0, dynamic_ncols=True):
        random = np.random.default_rng([seed, number])
        name = list(formats)[number % len(formats)]
        path, files = sound[name]
        for _ in range(int(random.choice([1, 1, 2, 4]))):
            files = edit(files, random) or files
        folder = place / "edited"
        for file, raw in files.items():
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            (folder / file).write_bytes(raw)
        signal.setitimer(signal.ITIMER_PROF, LONGEST)
        try:
            end = outcome(folder / path)
            if left := [str(f) for f in folder.rglob("*.tmp")]:
                raise AssertionError(f"left behind: {left}")
        except (Exception, Slow) as error:
            end = f"FAILED {type(error).__name__}"
            where = traceback.extract_tb(error.__traceback__)[-1]
            print(
                f"{name}, edit {number}: {type(error).__name__}: {str(error)[:200]} at {where.filename}:{where.lineno}",
                flush=True,
            )
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
            shutil.rmtree(folder, ignore_errors=True)
        ends[name][end] += 1
    shutil.rmtree(place)
    for name, counts in ends.items():
        print(f"{name:16}" + ", ".join(f"{count} {end}" for end, count in sorted(counts.items())))
    failed = sum(n for counts in ends.values() for end, n in counts.items() if end not in ("read", "refused"))
    print(f"{edits} edits, {failed} failed")
    return failed


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("edits", type=int, nargs="?", default=1000)
    parser.add_argument("seed", type=int, nargs="?", default=0)
    parser.add_argument("only", metavar="format", nargs="?", default="", help="the only format to test")
    args = parser.parse_args()
    sys.exit(bool(main(args.edits, args.seed, args.only)))
