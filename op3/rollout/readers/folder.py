"""Our own rollout folder: `metadata.yaml` and a memory-mapped TensorDict."""

from __future__ import annotations

from pathlib import Path

from op3.rollout.readers.ros import is_bag
from op3.rollout.rollout import DATA_FOLDER, METADATA_FILE, ROWS_FILE, Rollout


class Folder:
    """A folder that `Rollout.save` or a `Recorder` wrote, given by its path or its `metadata.yaml`."""

    title = "rollout folder"
    paths = "<folder>"

    def claims(self, path: Path) -> bool:
        """Recognised by the files in the folder."""
        folder = path.parent if path.name == METADATA_FILE else path
        parts = (folder / DATA_FOLDER / "meta.json").is_file() or (folder / ROWS_FILE).is_file()
        return parts or ((folder / METADATA_FILE).is_file() and not is_bag(folder))

    def read(self, path: Path) -> list[Rollout]:
        """One rollout, which may hold several episodes of equal length."""
        return [Rollout.load(path.parent if path.name == METADATA_FILE else path)]
