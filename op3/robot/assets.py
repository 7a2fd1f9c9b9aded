"""Where the data files of the package are: the folder `assets/`, in a checkout and in an installed wheel."""

from pathlib import Path

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


def named_configs(group: str) -> dict[str, Path]:
    """The config files of a group that come with the project, by name: ``conf/<group>/<name>.yaml``.

    Args:
        group: folder below `conf/`.
    """
    installed = _PACKAGE / "_files" / "conf" / group
    folder = installed if installed.is_dir() else _PACKAGE.parent / "conf" / group
    return {path.stem: path for path in sorted(folder.glob("*.yaml"))}
