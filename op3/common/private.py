"""Removes private data from texts: passwords in addresses, tokens, and the paths of the user's folders.

Everything that a run writes for others to read (pages, results, provenance, settings) passes through `scrub`.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

SECRET = "OP3_SECRET_"
"""Prefix of the environment variables that hold passwords of a command line, see `hide`."""

CLAIMED = "OP3_CLAIMED_FOLDER"
"""Environment variable with the run folder's setting if the user did not give it."""

_LOGIN = re.compile(r"(?P<before>[A-Za-z][A-Za-z0-9+.-]*://[^\s:/@]*:)(?P<secret>[^\s'\"]+)(?=@)")
_NAMED = re.compile(
    r"(?P<before>(?:password|passwd|passphrase|\bpwd?|(?:api|access|wandb)[-_]?key|bearer"
    r"|(?:(?<!\w )|(?=\w+=))(?:token|secret))"  # "unexpected token: x" is a sentence, not the name of a value
    r"(?!\W{0,2}\$\{)(?:\W{0,2}[=:]\W{0,2}|(?<=bearer) +))(?P<secret>[^\s'\",;&}*$]{3,})",
    re.IGNORECASE,
)
_PATH = re.compile(r"(?:(?<![\w./:~<-])|(?<=sqlite:///))/(?:[^\s/'\",;:\[\](){}<>=]+/)+[^\s/'\",;:\[\](){}<>=]*")


def scrub(value: Any) -> Any:
    """Values without secrets and paths of this machine: texts, including those in mappings and lists.

    A path below the working folder becomes relative; any other path is reduced to its last two parts.
    """
    if isinstance(value, Mapping):
        return {name: scrub(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return type(value)(scrub(item) for item in value)
    if isinstance(value, Path):
        return Path(scrub(str(value)))
    if not isinstance(value, str):
        return value
    return _PATH.sub(lambda found: _short(found[0]), masked(value))


def masked(text: str) -> str:
    """A text without passwords and tokens."""
    for name, secret in os.environ.items():
        if name.startswith(SECRET) and secret:
            text = text.replace(secret, "***")
    for pattern in (_LOGIN, _NAMED):
        text = pattern.sub(r"\g<before>***", text)
    return text


def _short(path: str) -> str:
    """A path without its location on this machine; texts that only resemble a path are unchanged."""
    first = Path(path).parts[1]
    if not (Path("/") / first).is_dir():
        return path
    here = f"{Path.cwd()}/"
    if path.startswith(here):
        return path.removeprefix(here)
    return "/".join(["...", *Path(path).parts[-2:]])


def hide(argument: str) -> str:
    """A command-line setting with its passwords moved to environment variables."""

    def move(found: re.Match[str]) -> str:
        if found["secret"].startswith(("${", "***")):
            return found[0]
        name = f"{SECRET}{sum(key.startswith(SECRET) for key in os.environ)}"
        os.environ[name] = found["secret"]
        return f"{found['before']}${{oc.env:{name}}}"

    return _NAMED.sub(move, _LOGIN.sub(move, argument))


def scrub_folder(folder: Path) -> None:
    """Remove secrets from the text files of a folder, for example from a library's output."""
    for file in (*folder.glob("*.yaml"), *folder.glob("*.log")):
        text = file.read_text(encoding="utf-8", errors="replace")
        if (clean := scrub(text)) != text:
            file.write_text(clean, encoding="utf-8")
