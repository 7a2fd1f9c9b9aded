"""Paths of the package's data files, in a checkout and in an installed wheel; names of robots and models.

It has no slow imports, so that wrong names on a command line are reported before anything else is imported.
"""

import difflib
from functools import lru_cache
from pathlib import Path
from typing import Any

from op3.common.settings import nearest, read_yaml

_PACKAGE = Path(__file__).resolve().parents[1]
_CANDIDATES = (_PACKAGE / "_files" / "assets", _PACKAGE.parent / "assets")
"""An installed wheel contains `op3/_files`; a checkout has `assets/` beside `op3/`."""


def asset_path(name: str) -> Path:
    """Absolute path of a file or folder of data.

    Args:
        name: path relative to `assets/`, such as "op3/op3.xml" or "servos".

    Raises:
        FileNotFoundError: if it does not exist; the message names the searched folders.
    """
    for folder in _CANDIDATES:
        if (folder / name).exists():
            return folder / name
    searched = " or ".join(str(folder) for folder in _CANDIDATES)
    raise FileNotFoundError(f"no asset {name!r} in {searched}; run from a checkout or install the wheel")


def here_or_shipped(path: str | Path) -> Path:
    """The path, or the package's file if the path begins with ``assets/`` and does not exist in the working folder."""
    if not isinstance(path, str | Path):
        raise ValueError(f"a path must be text, got {path!r}")
    path = Path(path)
    if path.parts[:1] == ("assets",) and not path.exists():
        return next((folder.parent / path for folder in _CANDIDATES if (folder.parent / path).exists()), path)
    return path


def conf_folder() -> Path:
    """The folder of the configs."""
    installed = _PACKAGE / "_files" / "conf"
    return installed if installed.is_dir() else _PACKAGE.parent / "conf"


def config_file(config: str) -> Path:
    """The file of a config, named relative to ``conf/``."""
    return conf_folder() / f"{config}.yaml"


@lru_cache(maxsize=1)
def config_variants() -> dict[str, dict[str, dict[str, Any]]]:
    """The configs of ``conf/variants.yaml``, by group with its package, as Hydra reads them."""
    groups = read_yaml(conf_folder() / "variants.yaml")
    for entries in groups.values():
        for name, fields in entries.items():
            if family := fields.pop("family", None):
                entries[name] = {"defaults": [family, "_self_"], **fields, "name": name}
    return groups


def named_configs(group: str) -> dict[str, Path | dict[str, Any]]:
    """The project's configs of a group, by name: a file of ``conf/<group>``, or a variant's content."""
    files = {path.stem: path for path in (conf_folder() / group).glob("*.yaml")}
    variants = {name.partition("@")[0]: entries for name, entries in config_variants().items()}
    return dict(sorted({**files, **variants.get(group, {})}.items()))


@lru_cache(maxsize=1)
def robot_files() -> dict[str, Path]:
    """The files of all robots that come with the project, by name."""
    return {path.stem: path.resolve() for path in sorted(asset_path("robots").glob("*.yaml"))}


def robot_file(name: str | Path) -> Path:
    """The file of a robot, by its name in ``assets/robots`` or by its path.

    Raises:
        ValueError: if neither exists.
    """
    known = robot_files()
    path = known.get(str(name)) or Path(name)
    if path.suffix in (".xml", ".urdf"):
        begin = f"format: op3-robot/1, name: <name>, model: {path.name}, servo: <make>, joints: {{<joint>: {{}}}}"
        raise ValueError(f"{path} is a model; a robot file is a .yaml beside it with {begin} (docs/your_robot.md)")
    if path.suffix not in (".yaml", ".yml"):
        raise ValueError(
            f"there is no robot {str(name)!r}{nearest(str(name), known)}; give a name or a path to a .yaml"
        )
    if not path.is_file():
        beside = difflib.get_close_matches(str(path), map(str, path.parent.glob("*.yaml")), n=1)
        close = f"; the nearest is {beside[0]!r}" if beside else nearest(path.stem, known)
        raise ValueError(f"there is no robot file {path}{close}; correct the path")
    return path


@lru_cache(maxsize=1)
def model_files() -> dict[str, Path]:
    """The files of all models that come with the project, by name."""
    return {path.stem: path for path in sorted(asset_path("models").glob("*.yaml"))}


def model_names() -> tuple[str, ...]:
    """Names of the models that come with the project, in ``assets/models``."""
    return tuple(model_files())


def find_model(name_or_path: str | Path) -> Path:
    """The file of a model: a path, a folder that contains a ``model.yaml``, or a name from `model_names`.

    Raises:
        FileNotFoundError: if none of these exists.
    """
    path = Path(name_or_path)
    if path.is_file():
        return path
    if path.is_dir() and (path / "model.yaml").is_file():
        return path / "model.yaml"
    if str(name_or_path) in model_files():
        return model_files()[str(name_or_path)]
    if path.is_dir():
        raise FileNotFoundError(
            f"the folder {path} has no model.yaml: give the folder of an identification or a diagnosis"
        )
    raise FileNotFoundError(
        f"there is no model file {str(name_or_path)!r}: give the path of a model.yaml or a name"
        + nearest(name_or_path, model_names())
    )
