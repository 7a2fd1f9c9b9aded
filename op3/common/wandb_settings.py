"""Settings for logging runs to Weights & Biases."""

import os
from collections.abc import Mapping
from typing import Any, Literal, get_args

from op3.common.settings import Listed, Text, settings

Mode = Literal["offline", "online", "disabled"]


@settings("wandb")
class WandbSettings:
    """Settings of a run's log, the group ``wandb`` of the configs.

    Attributes:
        mode: ``offline`` writes to the run's folder, ``online`` uploads, ``disabled`` does neither.
        project: project of the run.
        entity: team or user; None: the logged-in user's.
        tags: tags of the run.
        name: name of the run; None: the task or command and the seed.
    """

    mode: Mode = "offline"
    project: Text = "op3"
    entity: Text | None = None
    tags: Listed[Text] = ()
    name: Text | None = None

    @classmethod
    def of(cls, given: Any) -> "WandbSettings":
        """From a config's field: a mapping or, in older runs, only the mode; WANDB_MODE takes precedence.

        Raises:
            ValueError: if a field is invalid; the message names it.
        """
        values = dict(given) if isinstance(given, Mapping) else {"mode": given}
        if (mode := os.environ.get("WANDB_MODE")) in get_args(Mode):
            values["mode"] = mode
        return cls(**values)
