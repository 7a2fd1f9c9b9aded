"""The rollout: samples in a TensorDict, and their metadata."""

from __future__ import annotations

import dataclasses
import hashlib
import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from tensordict import TensorDict, TensorDictBase

from op3.common.writing import write_folder, write_text
from op3.robot.robot import DEFAULT, Robot, load_robot
from op3.robot.servo_make import ServoMake, find_servo
from op3.rollout import files
from op3.rollout.errors import LogError, located
from op3.rollout.metadata import OUTCOMES, Metadata
from op3.rollout.schema import CHANNELS, Key, column_names, key_name, normal_key
from op3.rollout.validate import by_episode, check_schema, check_values, known_channel

METADATA_FILE = "metadata.yaml"
DATA_FOLDER = "data"
ROWS_FILE = "rows.bin"

_log = logging.getLogger("op3.rollout")


@dataclass(frozen=True, eq=False)
class Rollout:
    """One log, or a batch of logs of equal length.

    Attributes:
        data: TensorDict of batch size [time] or [episode, time] with the channels of `CHANNELS`, float64
            (`done` is bool), on the CPU.
        metadata: Everything except the samples.
        findings: Problems reported by the checks, if they ran; see `op3.rollout.health`.

    Construction checks shapes, dtypes, finite values and increasing time, and raises `LogError` otherwise.
    """

    data: TensorDictBase
    metadata: Metadata
    findings: tuple[Any, ...] = ()

    def __post_init__(self):
        check_schema(dict(self.data.items(True, True)), self.data.batch_size, self.metadata)

    @classmethod
    def from_arrays(cls, arrays: Mapping[Any, Any], metadata: Metadata, source: str | Path | None = None) -> Rollout:
        """Build from arrays or tensors by key.

        Args:
            arrays: Keys as in `CHANNELS` (also `"joint/position"`); values [time, ...] or
                [episode, time, ...] of any number type. Scalar channels may omit the last axis.
            metadata: Everything except the samples.
            source: Source of the log, named in errors.
        """
        tensors = {normal_key(key): _tensor(value) for key, value in arrays.items()}
        with located(source=source or metadata.recording):
            batch = tensors.get(("joint", "position"), tensors.get("time", torch.zeros(0))[..., None]).shape[:-1]
            for key, tensor in tensors.items():
                if known_channel(key).axes == "scalar" and tensor.shape == batch:
                    tensor = tensor[..., None]
                if key == "done" and tensor.ndim == len(batch) + 1:
                    check_values(CHANNELS["done"], by_episode(tensor.double()), metadata)
                tensors[key] = tensor.bool() if key == "done" else tensor.double()
            check_schema(tensors, batch, metadata)
            data = TensorDict({}, batch_size=batch, device="cpu")
            for key, tensor in tensors.items():
                data[key] = tensor
            return cls(data, metadata)

    @property
    def joints(self) -> tuple[str, ...]:
        """Joint names, in the order of every [joint] axis."""
        return self.metadata.joints

    @property
    def robot(self) -> Robot:
        """The robot that has these joints.

        Raises:
            LogError: if its file is missing or invalid, or has not all of the joints.
        """
        robot = self.named_robot
        other = [joint for joint in self.joints if joint not in robot.joints]
        if other and self.metadata.mount != "pendulum":
            problem = f"{robot.name} has no joint {', '.join(other[:6])}"
            remedy = "name the log's robot with robot=<name or file> or `robot_file` in the log's YAML"
            raise LogError(problem, remedy, source=self.metadata.recording)
        return robot

    @property
    def named_robot(self) -> Robot:
        """The robot that the metadata name, whether or not it has these joints."""
        # logs of the OP3 do not name a file
        name = self.metadata.robot_file or ("bench" if self.metadata.mount == "pendulum" else DEFAULT)
        try:
            return load_robot(name)
        except ValueError as error:
            remedy = "correct `robot_file` in the metadata, or give robot=<path>"
            raise LogError(str(error), remedy, source=self.metadata.recording, column="field robot_file") from None

    @property
    def servos(self) -> list[ServoMake | None]:
        """The make of each joint's servo; None if unknown."""
        if self.metadata.mount == "pendulum":
            return [find_servo(self.metadata.servo)] * len(self.joints)
        try:
            known = dict(zip(self.named_robot.joints, self.named_robot.servos, strict=True))
        except LogError:
            known = {}
        return [known.get(joint) for joint in self.joints]

    @property
    def channels(self) -> tuple[Key, ...]:
        """Keys of the channels that are present, in the order of `CHANNELS`."""
        present = set(self.data.keys(True, True))
        return tuple(key for key in CHANNELS if key in present)

    @property
    def duration(self) -> float:
        """Time from the first to the last row [s]; for a batch, the longest time."""
        time = self.data["time"][..., 0]
        return float((time[..., -1] - time[..., 0]).max())

    @property
    def rows(self) -> int:
        """Rows per episode."""
        return self.data.batch_size[-1]

    @property
    def batched(self) -> bool:
        """Whether there is an episode axis."""
        return len(self.data.batch_size) == 2

    def __len__(self) -> int:
        return self.rows

    def __contains__(self, key: object) -> bool:
        return isinstance(key, str | tuple) and normal_key(key) in self.channels

    def fingerprint(self) -> str:
        """Twelve hex digits that identify a recording by its times and angles."""
        parts = (np.ascontiguousarray(self.array(key)).tobytes() for key in ("time", "joint/position"))
        return hashlib.sha256(b"".join(parts)).hexdigest()[:12]

    def content_hash(self) -> str:
        """Twelve hex digits of everything a simulation of the recording depends on: channels, set-aside columns and
        metadata, but not its name, its date and the version of the code."""
        about = {k: v for k, v in self.metadata.to_dict().items() if k not in ("recording", "date", "git_hash", "seed")}
        digest = hashlib.sha256(yaml.safe_dump(about).encode())
        for key in self.channels:
            digest.update(key_name(key).encode() + np.ascontiguousarray(self.array(key)).tobytes())
        return digest.hexdigest()[:12]

    def array(self, key: str | tuple[str, ...]) -> np.ndarray:
        """A channel as numpy, [time, last axis] or [episode, time, last axis], without copying."""
        name = normal_key(key)
        if name not in self.channels:
            there = ", ".join(key_name(k) for k in self.channels)
            raise LogError(f"the log has no {key_name(name)}", f"it has {there}", source=self.metadata.recording)
        return self.data[name].detach().numpy()

    def column(self, name: str) -> np.ndarray:
        """One column by its CSV name (`elbow.position`, `imu.roll`), [time] or [episode, time]."""
        for key in self.channels:
            columns = self._columns(key)
            if name in columns:
                return self.array(key)[..., columns.index(name)]
        remedy = "it has " + ", ".join(CHANNELS[key].column for key in self.channels)
        raise LogError("the log has no such column", remedy, source=self.metadata.recording, column=name)

    def _columns(self, key: Key) -> tuple[str, ...]:
        """CSV columns of a channel."""
        return column_names(CHANNELS[key], self.joints, self.data[key].shape[-1])

    def episodes(self) -> tuple[Rollout, ...]:
        """The single logs of a batch; for a log without an episode axis, the log itself."""
        return tuple(self.episode(i) for i in range(self.data.batch_size[0])) if self.batched else (self,)

    def episode(self, index: int) -> Rollout:
        """One log of a batch, with the distance, duration and fall of this episode in the metadata."""
        if not self.batched:
            raise LogError("the log has no episode axis", "use it directly", source=self.metadata.recording)
        values = {name: getattr(self.metadata, name) for name in OUTCOMES}
        picked = {name: v[index] if isinstance(v, tuple) else v for name, v in values.items()}
        return dataclasses.replace(self, data=self.data[index], metadata=self.metadata.replace(**picked))

    def between(self, start: float, end: float) -> Rollout:
        """The rows with start <= time < end [s] of a log without an episode axis; shares its memory."""
        if self.batched:
            raise LogError("the log has an episode axis", "take one episode first", source=self.metadata.recording)
        first, last = np.searchsorted(self.array("time")[:, 0], [start, end])
        if last <= first:
            time = self.array("time")[:, 0]
            problem = f"no row lies between {start:g} s and {end:g} s"
            remedy = f"the log runs from {time[0]:g} s to {time[-1]:g} s"
            raise LogError(problem, remedy, source=self.metadata.recording, column="time")
        return dataclasses.replace(self, data=self.data[int(first) : int(last)])

    def check(self, source: str | Path | None = None, said: Path | None = None) -> Rollout:
        """Run the checks, and raise `LogError` if the log has an error.

        Args:
            source: Source of the log, named in errors.
        said: File with the metadata, named in errors about metadata.

        Returns:
            The log with warnings in `findings`. Unusable channels of joints are excluded, see `measured`; a channel
            that is unusable in all joints is removed.
        """
        # the checks import this module
        from op3.rollout.health import ERROR, examine, merge_findings

        source = source or self.metadata.recording
        findings = examine(self)
        for finding in merge_findings([*self.findings, *findings]):  # `self.findings` are from the reader
            where = said if said and str(finding.column).startswith("field ") else source
            if finding.severity == ERROR:
                raise finding.error(where)
            _log.warning("%s", finding.error(where if where is None else Path(where).name))
        return self.with_findings(findings)

    def with_findings(self, findings: Sequence[Any]) -> Rollout:
        """The log with these problems added and their columns excluded; see `measured`."""
        aside = {str(finding.column) for finding in findings if finding.set_aside}
        return dataclasses.replace(self._without(aside), findings=(*self.findings, *findings)) if findings else self

    def measured(self, key: str | tuple[str, ...]) -> np.ndarray:
        """Which columns of a channel are measured, [last axis]; the others are excluded."""
        return np.array([column not in self.metadata.set_aside for column in self._columns(normal_key(key))])

    def _without(self, aside: set[str]) -> Rollout:
        """The log with these columns excluded.

        To keep all values finite, a position is filled with the command, a velocity with the derivative of position,
        and any other column with the median of the other joints. A trunk sensor's vector is removed completely.
        """
        if not aside:
            return self
        data, every = self.data.clone(False), {*aside, *self.metadata.set_aside}
        for key in self.channels:
            bad = np.array([column in every for column in self._columns(key)])
            if bad.all() or (key[0] == "imu" and bad.any()):
                del data[key]
            elif bad.any():
                values = self.array(key).copy()
                if key == ("joint", "position"):
                    values[..., bad] = self.array("command/position")[..., bad]
                elif key == ("joint", "velocity"):
                    for where in np.ndindex(values.shape[:-2]):
                        time, position = (self.array(k)[where] for k in ("time", "joint/position"))
                        values[where][:, bad] = np.gradient(position[:, bad], time[:, 0], axis=0)
                else:
                    values[..., bad] = np.median(values[..., ~bad])
                data[key] = torch.from_numpy(values)
        return Rollout(data, self.metadata.replace(set_aside=sorted(every)))

    def save(self, folder: str | Path, overwrite: bool = False) -> Path:
        """Write `metadata.yaml` and the memory-mapped TensorDict `data/` atomically.

        Args:
            folder: New folder. An existing rollout is replaced only with `overwrite`; other folders are never changed.
            overwrite: Whether to replace an existing rollout.
        """
        folder = Path(folder)
        if folder.exists() and not (folder / METADATA_FILE).is_file():
            raise LogError("the folder exists and is not a rollout", "choose another folder", source=folder)

        def fill(temporary: Path) -> None:
            files.save_tensordict(self.data, temporary / DATA_FOLDER)
            write_text(temporary / METADATA_FILE, self.metadata.to_yaml())

        write_folder(folder, fill, overwrite)
        return folder

    @classmethod
    def load(cls, folder: str | Path) -> Rollout:
        """Map a saved rollout into memory, copy-on-write.

        An interrupted recording loads with every saved row, and its metadata has `complete: false`.
        """
        folder = Path(folder)
        if not (folder / METADATA_FILE).is_file():
            raise LogError(f"no {METADATA_FILE} in this folder", "name a rollout folder", source=folder)
        metadata = Metadata.read(folder / METADATA_FILE)
        if not (folder / DATA_FOLDER).is_dir() and (folder / ROWS_FILE).is_file():
            return cls.from_arrays(files.read_rows(folder / ROWS_FILE), metadata.replace(complete=False), folder)
        data = files.map_tensordict(folder / DATA_FOLDER)
        with located(source=folder):
            return cls(data, metadata)

    def to_csv(self, path: str | Path, overwrite: bool = False) -> Path:
        """Write a wide CSV and its sidecar `<name>.yaml`; `read_log` returns the same numbers.

        Each file is replaced atomically.
        """
        path = Path(path)
        if self.batched:
            raise LogError("a CSV contains one episode", "write rollout.episode(i)", source=path)
        if path.suffix != ".csv":
            raise LogError("the name does not end in .csv", "name the file <name>.csv", source=path)
        for file in (path, path.with_suffix(".yaml")):
            if file.exists() and not overwrite:
                remedy = "choose another name or pass overwrite=True"
                raise LogError("the file already exists", remedy, source=file)
        header, columns = [], []
        for key in self.channels:
            header += self._columns(key)
            columns.append(self.array(key).astype(float))
        lines = [",".join(header)]
        lines += [",".join(map(repr, row)) for row in np.concatenate(columns, axis=1).tolist()]
        path.parent.mkdir(parents=True, exist_ok=True)
        write_text(path.with_suffix(".yaml"), self.metadata.to_yaml())
        write_text(path, "\n".join(lines) + "\n")
        return path


def _tensor(value: Any) -> torch.Tensor:
    if isinstance(value, torch.Tensor):
        return value.detach().cpu()
    return torch.as_tensor(np.ascontiguousarray(value))
