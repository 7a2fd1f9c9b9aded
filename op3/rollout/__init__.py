"""The one log format: a TensorDict schema, recorder, files and importers."""

from typing import TYPE_CHECKING

from op3.common.lazy import lazy

if TYPE_CHECKING:
    from op3.rollout.code_version import git_changes, git_hash
    from op3.rollout.errors import LogError
    from op3.rollout.metadata import MOUNTS, Metadata
    from op3.rollout.read import read_episodes, read_log, read_logs
    from op3.rollout.recorder import Recorder
    from op3.rollout.robot_log import stand_tilt
    from op3.rollout.rollout import Rollout
    from op3.rollout.schema import CHANNELS, column_names, schema_table

__all__ = [
    "CHANNELS",
    "MOUNTS",
    "LogError",
    "Metadata",
    "Recorder",
    "Rollout",
    "column_names",
    "git_changes",
    "git_hash",
    "read_episodes",
    "read_log",
    "read_logs",
    "schema_table",
    "stand_tilt",
]

__getattr__ = lazy(__name__)
