"""``op3 <command> [overrides]``: all commands, with one-sentence errors.

The overrides are those of Hydra, as for ``python experiments/<name>.py``; both call `launch`. Wrong names are reported
before the libraries of a command are imported.
"""

import importlib.metadata
import itertools
import os
import re
import shutil
import signal
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import NoReturn

from op3.apps import COMMANDS
from op3.apps.command_help import PRESETS, asked_for, completion, overview, usage
from op3.common.assets import config_file
from op3.common.private import CLAIMED, hide, masked, scrub_folder
from op3.common.settings import nearest


def main(arguments: Sequence[str] | None = None) -> None:
    """Run ``op3``.

    Args:
        arguments: the command and its overrides; None: the arguments of the process.
    """
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)  # `op3 --help | head` ends as other commands do
    given = list(sys.argv[1:] if arguments is None else arguments)
    if not given or given[0] in ("-h", "--help", "help"):
        print(overview())
        return
    if given[0] == "--version":
        print(importlib.metadata.version("op3"))
        return
    words = 2 if " ".join(given[:2]) in COMMANDS else 1
    command, rest = " ".join(given[:words]), given[words:]
    if command in ("doctor", "completion"):
        if rest:
            end(f"{command} takes no settings, got {rest[0]}")
        from op3.common.doctor import report

        print(report() if command == "doctor" else completion())
        return
    if command not in COMMANDS:
        end(f"unknown command {command!r}{nearest(command, [*COMMANDS, 'doctor', 'completion'])}")
    app = COMMANDS[command]
    if rest and not rest[0].startswith(("-", "~")) and (os.path.exists(rest[0]) or "=" not in rest[0]):
        if (asked := asked_for(app)) is None:
            longer = [name for name in COMMANDS if name.startswith(f"{command} ")]
            close = nearest(f"{command} {rest[0]}", longer) if longer else ""
            end(f"{rest[0]} is not a setting: write setting=value{close}")
        rest[0] = f"{asked}={rest[0]}"
    if not {"-h", "--help"} & set(rest):
        signal.signal(signal.SIGPIPE, signal.SIG_IGN)  # as Python has it: a closed socket is an error, not the end
    sys.argv = ["op3", *PRESETS.get(command, ()), *rest]
    launch(app)


def launch(app: str, module: str = "") -> None:
    """Run a command with the overrides of the process, as ``python experiments/<app>.py`` does.

    Prints op3's own help, accepts paths with any character, and reports wrong names in one sentence before large
    libraries are imported.

    Args:
        app: name of the config.
        module: with the command's `main`; that of the same name in `op3.apps` where empty.
    """
    try:
        _launch(app, module)
    except KeyboardInterrupt:  # before the work has begun, or between two jobs
        print("\nInterrupted.", file=sys.stderr)
        raise SystemExit(130) from None


def _launch(app: str, module: str) -> None:
    if {"-h", "--help"} & set(sys.argv[1:]):
        print(usage(app))
        return
    import hydra
    from hydra._internal.utils import get_args_parser
    from hydra.core.hydra_config import HydraConfig
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    from op3.apps.job import Job, check_first_job
    from op3.apps.sentences import explained
    from op3.identify.registration import register

    words = ["confirm=false" if word == "--yes" else word for word in sys.argv[1:]]
    words += choices_of_resumed(words)
    sys.argv[1:] = sorted(words, key=lambda word: word not in ("-m", "--multirun"))  # Hydra wants them first
    parser = get_args_parser()
    parser.error = lambda message: end(f"{message}; settings are written setting=value, and --help lists them")
    parser.parse_args(sys.argv[1:])
    if empty := next((word for word in sys.argv[1:] if word.endswith(".dir=")), None):
        end(f"{empty} is empty: give a folder, or omit this setting")
    kind = _kind(app, sys.argv[1:])
    # Hydra ignores the folder of the other kind
    words = [re.sub(r"^(\+*hydra)\.(run|sweep)\.dir=", rf"\1.{kind}.dir=", word) for word in sys.argv[1:]]
    sys.argv[1:] = [hide(quoted(word)) for word in words]
    # Hydra's own handler prints a wall of text; with this it lets errors through
    os.environ.setdefault("HYDRA_FULL_ERROR", "1")
    asked = _asked_folder(app, kind, sys.argv[1:])
    if asked is not None and (other := taken(asked)) not in (None, app):
        end(f"{asked} is the folder of a run of {other}, which would be overwritten: choose another hydra.run.dir")
    missing = 0 if asked is None else sum(not place.exists() for place in (asked, *asked.parents))
    folder = None
    with record_kept(asked):
        try:
            register()
            if kind == "sweep":
                check_first_job(app, [word for word in sys.argv[1:] if not word.startswith("-")])
            folder = claim(app, sys.argv[1:])
            if folder is not None:
                sys.argv.append(os.environ.setdefault(CLAIMED, f"hydra.{kind}.dir={folder}"))
            file = config_file(app)
            hydra.main(config_path=str(file.parent), config_name=file.stem, version_base="1.3")(Job(app, module))()
        except (HydraException, OmegaConfBaseException, OSError) as error:
            end(masked(explained(error, app)))
        except RuntimeError as error:
            if "srun" not in str(error):  # what submitit looks for
                raise
            end("hydra/launcher=submitit_slurm: Slurm (srun) is not installed here; start it on a submit node")
        except ValueError as error:
            if HydraConfig.initialized():  # it is ours, and a mistake
                raise
            end(masked(explained(error, app)))
        finally:
            place = folder or asked
            if kind == "sweep" and place is not None:
                compare(place)
            if place is not None and (folder or missing):
                leave(place, above=2 if folder else missing - 1)


@contextmanager
def record_kept(folder: Path | None) -> Iterator[None]:
    """Restore Hydra's record of an earlier run in a folder if the command that names the folder is refused."""
    record = {} if folder is None else {file: file.read_bytes() for file in (folder / ".hydra").glob("*.yaml")}
    try:
        yield
    except SystemExit as stop:
        if stop.code == 1:
            for file, content in record.items():
                file.write_bytes(content)
        raise


def choices_of_resumed(words: Sequence[str]) -> list[str]:
    """The config groups that a run to be resumed has chosen, so that each can be overridden."""
    given = {name: value for name, _, value in (word.partition("=") for word in words)}
    file = Path(given.get("resume", "").strip("'\"")) / ".hydra" / "hydra.yaml"
    if "resume" not in given or not file.is_file():
        return []
    chosen = re.findall(r"^      (task|algorithm|recipe|budget): '?(\w+)'?$", file.read_text("utf-8"), re.MULTILINE)
    return [f"{name}={value}" for name, value in chosen if name not in given]


def compare(folder: Path) -> None:
    """Write one page about the finished runs of a multirun, and print its path and its variants."""
    if len(list(folder.glob("*/result.yaml"))) < 2:
        return
    from op3.report.comparison_page import read_runs, variants, write_comparison

    runs = read_runs(folder)
    print(*write_comparison(runs, folder), f"variants: {'; '.join(variants(runs))}", sep="\n", flush=True)


def claim(config: str, arguments: Sequence[str]) -> Path | None:
    """Create a separate folder for the run at once, so that two runs that start in the same second do not share one.

    Returns:
        None if the user or the config names another folder, or if nothing is run.
    """
    flags = {word for word in arguments if word.startswith("-")} - {"-m", "--multirun"}
    if flags or any(re.match(r"\+*hydra\.(run|sweep)\.dir=", word) for word in arguments):
        return None
    if "\n  - run_folder" not in _text(config):
        return None
    now = datetime.now().strftime("%Y-%m-%d_%H-%M-%S")
    for number in itertools.count(1):
        folder = Path("outputs", config) / (now if number == 1 else f"{now}_{number}")
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            continue
        break
    return folder


def taken(folder: Path) -> str | None:
    """The experiment whose run is in a folder; None if there is none."""
    file = folder / ".hydra" / "hydra.yaml"
    found = re.search(r"^  job:\n    name: (\w+)", file.read_text("utf-8"), re.MULTILINE) if file.is_file() else None
    return found and found[1]


def _asked_folder(config: str, kind: str, arguments: Sequence[str]) -> Path | None:
    """The folder that the overrides name, otherwise the config's folder if it is constant."""
    found = [re.match(rf"\+*hydra\.{kind}\.dir=(.+)", word) for word in arguments]
    found.append(re.search(rf"^  {kind}:\n    dir: (outputs/\w+)$", _text(config), re.MULTILINE))
    return next((Path(one[1].strip("'\"")) for one in found if one), None)


def _kind(config: str, arguments: Sequence[str]) -> str:
    several = {"-m", "--multirun"} & set(arguments) or "\n  mode: MULTIRUN\n" in _text(config)
    return "sweep" if several else "run"


def _text(config: str) -> str:
    return config_file(config).read_text(encoding="utf-8") if config_file(config).is_file() else ""


def leave(folder: Path, above: int = 0) -> None:
    """Remove secrets and paths from Hydra's files, and delete the folder if the run has written nothing else."""
    for place in (folder, *folder.rglob(".hydra")):
        if place.is_dir():
            scrub_folder(place)
    files = [file for file in folder.rglob("*") if file.is_file() and ".hydra" not in file.parts]
    if not any(file.stat().st_size for file in files if file.name != "multirun.yaml"):
        shutil.rmtree(folder, ignore_errors=True)
    for place in (folder, *list(folder.parents)[:above]):
        if place.is_dir() and not any(place.iterdir()):
            place.rmdir()


def quoted(argument: str) -> str:
    """An override with quotes if Hydra's grammar cannot read its value otherwise, such as a path with spaces."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    name, equals, value = argument.partition("=")
    if argument.startswith("-") or not equals:
        return argument
    try:
        OverridesParser.create().parse_override(argument)
        if not (os.path.exists(value) and re.search(r"[\s=,()]", value)):
            return argument
    except HydraException:
        pass
    if value.startswith("[") and value.endswith("]"):  # a list, such as of overrides with equals signs of their own
        return f"{name}=[{','.join(map(_in_quotes, value[1:-1].split(',')))}]"
    return f"{name}={_in_quotes(value)}"


def _in_quotes(text: str) -> str:
    escaped = text.strip(" '\"").replace("\\", "\\\\").replace("'", "\\'")
    return f"'{escaped}'"


def end(sentence: str) -> NoReturn:
    """Print the error, and end with exit code 1."""
    print(sentence, file=sys.stderr)
    raise SystemExit(1)
