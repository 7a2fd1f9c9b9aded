"""Where the data files of the package are, in a checkout and in an installed wheel; names of robots and models.

Imports nothing heavy: wrong names on a command line are refused here before anything else is imported.
"""

from functools import lru_cache
from pathlib import Path
from typing import Any

from op3.common.settings import nearest, read_yaml

_PACKAGE = Path(__file__).resolve().parents[1]
_CANDIDATES = (_PACKAGE / "_files" / "assets", _PACKAGE.parent / "assets")
"""An installed wheel carries `op3/_files`; a checkout has `assets/` beside `op3/`."""


def asset_path(name: str) -> Path:
    """Absolute path of a file or folder of data.

    Args:
        name: path relative to `assets/`, such as "op3/op3.xml" or "servos".

    Raises:
        FileNotFoundError: naming the folders that were searched.
    """
    for folder in _CANDIDATES:
        if (folder / name).exists():
            return folder / name
    searched = " or ".join(str(folder) for folder in _CANDIDATES)
    raise FileNotFoundError(f"no asset {name!r} in {searched}; run from a checkout or install the wheel")


def here_or_shipped(path: str | Path) -> Path:
    """The path, or that of the package where it begins with ``assets/`` and is not below the working folder."""
    if not isinstance(path, str | Path):
        raise ValueError(f"a path must be a text, got {path!r}")
    path = Path(path)
    if path.parts[:1] == ("assets",) and not path.exists():
        return next((folder.parent / path for folder in _CANDIDATES if (folder.parent / path).exists()), path)
    return path


def conf_folder() -> Path:
    """The folder of the configs."""
    installed = _PACKAGE / "_files" / "conf"
    return installed if installed.is_dir() else _PACKAGE.parent / "conf"


def named_configs(group: str) -> dict[str, Path]:
    """The config files of a group that come with the project, by name: ``conf/<group>/<name>.yaml``.

    Args:
        group: folder below `conf/`.
    """
    return {path.stem: path for path in sorted((conf_folder() / group).glob("*.yaml"))}


@lru_cache(maxsize=1)
def motion_variants() -> dict[str, dict[str, Any]]:
    """Motions of ``conf/motion_variants.yaml`` by name: their `family`, a config of ``conf/motion``, and its fields."""
    return read_yaml(conf_folder() / "motion_variants.yaml")


def motion_names() -> tuple[str, ...]:
    """Names of the motions that come with the project, families and their variants."""
    return tuple(sorted({*named_configs("motion"), *motion_variants()}))


@lru_cache(maxsize=1)
def robot_files() -> dict[str, Path]:
    """The files of all robots that come with the project, by name."""
    return {path.stem: path.resolve() for path in sorted(asset_path("robots").glob("*.yaml"))}


def robot_file(name: str | Path) -> Path:
    """The file of a robot, by its name in ``assets/robots`` or by its path.

    Raises:
        ValueError: if there is neither.
    """
    known = robot_files()
    path = known.get(str(name)) or Path(name)
    if path.suffix not in (".yaml", ".yml"):
        raise ValueError(f"there is no robot {str(name)!r}{nearest(str(name), known)}, or give the path of a .yaml")
    if not path.is_file():
        raise ValueError(f"there is no robot file {path}{nearest(path.stem, known)}, or correct the path")
    return path


@lru_cache(maxsize=1)
def model_files() -> dict[str, Path]:
    """The files of all models that come with the project, by name."""
    return {path.stem: path for path in sorted(asset_path("models").glob("*.yaml"))}


def model_names() -> tuple[str, ...]:
    """Names of the models that come with the project, in ``assets/models``."""
    return tuple(model_files())


def find_model(name_or_path: str | Path) -> Path:
    """The file of a model: a path, a folder that holds a ``model.yaml``, or a name from `model_names`.

    Raises:
        FileNotFoundError: if there is none of these.
    """
    path = Path(name_or_path)
    if path.is_file():
        return path
    if path.is_dir() and (path / "model.yaml").is_file():
        return path / "model.yaml"
    if str(name_or_path) in model_files():
        return model_files()[str(name_or_path)]
    raise FileNotFoundError(
        f"there is no model file {str(name_or_path)!r}: give the path of a model.yaml or a name"
        + nearest(name_or_path, model_names())
    )
