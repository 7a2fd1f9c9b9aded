"""A thin wrapper of wandb, by default offline, quiet and without an account."""

import glob
import hashlib
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Self

from op3.common.private import scrub
from op3.common.wandb_settings import WandbSettings


def sweep_group(folder: str | Path) -> str:
    """The wandb group of a run, derived from its folder.

    Jobs of a Hydra multirun are numbered folders inside the sweep's, whose name (with the day's folder above it)
    is the group; any other folder is a separate group.
    """
    folder = Path(folder).resolve()
    sweep = folder.parent if folder.name.isdecimal() else folder
    return f"{sweep.parent.name}/{sweep.name}".strip("/")


def files_of(where: Any) -> list[Path]:
    """Files in a path, a pattern, a folder or a list of these; hidden files are omitted."""
    if isinstance(where, list | tuple):
        return [file for one in where for file in files_of(one)]
    found = [Path(path) for path in sorted(glob.glob(str(where)))]
    inside = [file for path in found for file in (sorted(path.rglob("*")) if path.is_dir() else [path])]
    return [file for file in inside if file.is_file() and not any(part.startswith(".") for part in file.parts[-3:])]


def artifact_name(kind: str, files: Sequence[Path]) -> str:
    """Artifact name from the kind and the content of files: equal content gives equal names."""
    digest = hashlib.sha256(b"".join(sorted(hashlib.sha256(file.read_bytes()).digest() for file in files)))
    return f"{kind}-{digest.hexdigest()[:12]}"


class RunLogger:
    """Logs one run to wandb, as a context manager.

    By default the run is written to ``<folder>/wandb`` and nothing leaves the machine; ``wandb sync`` uploads it
    later. Runs of one sweep form a group. A run's name is that of its folder unless the settings name it.

    Args:
        config: plain settings of the run.
        wandb: mode, project, entity, tags and name; by default offline, or set by WANDB_MODE.
    """

    def __init__(
        self, folder: str | Path, *, config: Mapping[str, Any] | None = None, wandb: WandbSettings | None = None
    ):
        chosen = wandb or WandbSettings.of("offline")
        mode = chosen.mode
        if mode != "online":
            os.environ.setdefault("WANDB_ERROR_REPORTING", "false")
        import wandb as library  # after the line above, which it reads once; half a second that others need not pay

        self._wandb, self._online = library, mode == "online"
        folder, quiet = Path(folder), not self._online
        folder.mkdir(parents=True, exist_ok=True)
        settings = library.Settings(
            silent=quiet, console="off", disable_code=True, disable_git=True, x_disable_meta=quiet,
            x_disable_stats=quiet,
        )  # fmt: skip
        try:
            self._run = library.init(
                project=chosen.project, entity=chosen.entity, tags=chosen.tags, group=sweep_group(folder),
                name=chosen.name or folder.resolve().name, dir=str(folder), config=scrub(dict(config or {})), mode=mode,
                reinit="create_new", settings=settings,
            )  # fmt: skip
        except library.errors.Error as error:
            problem = str(error).strip().splitlines()[0].rstrip(".")
            raise ValueError(
                f"wandb={mode}: {problem}; log in with `wandb login`, or write wandb=offline, which needs no account"
            ) from error

    def log(self, values: Mapping[str, float], step: int | None = None) -> None:
        """Log numbers; steps must not decrease. Without a step, wandb counts calls."""
        self._run.log(dict(values), step=step)

    def film(self, name: str, path: Path) -> None:
        """Log an mp4."""
        self._run.log({name: self._wandb.Video(str(path))})

    def summary(self, values: Mapping[str, Any]) -> None:
        """Set the summary numbers of the run in wandb's tables."""
        self._run.summary.update(dict(values))

    def lineage(self, used: Sequence[tuple[str, Any]], made: Sequence[tuple[str, Any]]) -> None:
        """Record the input and output artifacts of a run.

        Artifacts are named by their content, so that the output of one run and the input of another are the same
        artifact, even offline. Offline wandb accepts no inputs, so the run's config and its outputs name them.

        Args:
            used: kind and path, pattern or list of paths.
            made: outputs, as for `used`.
        """
        inputs = [(kind, files) for kind, where in used if (files := files_of(where))]
        names = [artifact_name(*each) for each in inputs]
        self._run.config.update({"made_from": names})
        if self._online:
            for kind, files in inputs:
                self._run.use_artifact(self._artifact(kind, files))
        for kind, where in made:
            self._run.log_artifact(self._artifact(kind, files_of(where), {"made_from": names}))

    def _artifact(self, kind: str, files: Sequence[Path], metadata: Mapping[str, Any] | None = None) -> Any:
        artifact = self._wandb.Artifact(artifact_name(kind, files), kind, metadata=dict(metadata or {}))
        above = Path(os.path.commonpath([file.parent for file in files]))
        for file in files:  # the files remain in the run's folder
            artifact.add_file(str(file), str(file.relative_to(above)), policy="immutable", skip_cache=True)
        return artifact

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: Any) -> None:
        self._run.finish(exit_code=int(kind is not None))
