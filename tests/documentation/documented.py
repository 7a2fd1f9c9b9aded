"""The commands that README.md and docs/ show, as a shell would get them."""

import re
import shlex
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]

STANDS_FOR: Mapping[str, str] = {
    "log": "given/log",
    "other log": "given/other_log",
    "logs": "given/logs",
    "calibration": "given/calibration.yaml",
    "model": "given/model.yaml",
    "other model": "given/other_model.yaml",
    "policy": "assets/policies/balance",
    "other policy": "assets/policies/walk",
    "episodes": "given/episodes",
    "runs": "given/runs",
    "sts3032": "../shared/data/servo_bench/sts3032",
    "xl330": "../shared/data/servo_bench/xl330",
    "sage pairs": "../shared/data/foreign/so101",
    "task": "walk",
    "world": "robot_4",
    "partition": "cpu",
    "host": "op3.local",
}
"""What a reader puts in place of ``<name>``, beside the checkout's own files."""

_FENCE = re.compile(r"^( *)```(?:sh|bash)\n(.*?)^\1```", re.MULTILINE | re.DOTALL)
_INLINE = re.compile(r"(?<!`)`((?:op3 |python experiments/|make |pip )[^`]+)`(?!`)", re.DOTALL)
_PLACE = re.compile(r"<([a-z0-9 ]+)>")
_FILE = re.compile(r"^```\w+\n(?:# |<!-- )(\S+\.\w+)(?: -->)?\n(.*?)^```", re.MULTILINE | re.DOTALL)
_END = re.compile(r"exit code (\d+)")


@dataclass(frozen=True)
class Command:
    """One command of a page.

    Attributes:
        page: file name of the page.
        line: where it stands there.
        words: program and arguments; what follows a pipe is a command of its own.
        code: exit code that the page promises in the command's comment, as ``# exit code 40``.
    """

    page: str
    line: int
    words: tuple[str, ...]
    code: int = 0

    def __str__(self) -> str:
        return f"{self.page}:{self.line}: {shlex.join(self.words)}"

    @property
    def ours(self) -> bool:
        """Whether this project answers it."""
        return self.words[0] == "op3" or any(word.startswith("experiments/") for word in self.words[1:2])

    @property
    def script(self) -> Path | None:
        """The experiment that ``python experiments/<name>.py`` or ``op3 <command>`` starts; None of another program."""
        from op3.apps import COMMANDS

        program, *rest = self.words
        if program == "python" and self.ours:
            return ROOT / rest[0]
        named = [" ".join(rest[:count]) for count in (2, 1) if " ".join(rest[:count]) in COMMANDS]
        return ROOT / "experiments" / f"{COMMANDS[named[0]]}.py" if program == "op3" and named else None


def commands(page: Path) -> Iterator[Command]:
    """All commands of a page, in its order: lines of shell blocks, and commands in the running text.

    Raises:
        ValueError: for a placeholder that `STANDS_FOR` does not have; a reader would have to guess.
    """
    text = page.read_text(encoding="utf-8")
    found = [(match.start(2), match[2]) for match in _FENCE.finditer(text)]
    found += [(match.start(1), " ".join(match[1].split())) for match in _INLINE.finditer(_blank(text))]
    for start, block in sorted(found):
        number = text.count("\n", 0, start) + 1
        for line in block.replace("\\\n", " \0").split("\n"):
            yield from _of_line(page.name, number, line.replace("\0", ""))
            number += 1 + line.count("\0")


def files(page: Path) -> dict[str, str]:
    """Files that a page lets its reader write: blocks whose first line is a comment that names one."""
    return dict(_FILE.findall(page.read_text(encoding="utf-8")))


def _blank(text: str) -> str:
    """A page without its blocks, every character at its place."""
    return re.sub(r"^( *)```.*?^\1```", lambda m: re.sub(r"[^\n]", " ", m[0]), text, flags=re.MULTILINE | re.DOTALL)


def _of_line(page: str, number: int, line: str) -> Iterator[Command]:
    line, _, comment = line.partition("#") if line.startswith("#") else line.partition(" #")
    filled = _PLACE.sub(lambda match: STANDS_FOR.get(match[1], match[0]), line)
    if unknown := re.search(r"<[^<>=]+>", filled):
        raise ValueError(f"{page}:{number}: {unknown[0]} is none of {', '.join(f'<{name}>' for name in STANDS_FOR)}")
    promised = _END.search(comment)
    lexer = shlex.shlex(filled, posix=True, punctuation_chars="|&;<>")
    lexer.whitespace_split = True
    words: list[str] = []
    for word in [*lexer, ";"]:
        if word and set(word) <= set("|&;<>"):
            named = [w for w in words if not re.match(r"[A-Z_]+=", w)] if words else []
            if named:
                yield Command(page, number, tuple(named), int(promised[1]) if promised else 0)
            words = []
        else:
            words.append(word)
