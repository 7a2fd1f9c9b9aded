"""All effects of the catalogue as one compiled law of a joint.

The functions of all effects run in the order of their stages, each switched by a bit, so that one compiled kernel
serves all combinations. The attributes of this module that `op3.servo.rows` and simulations call (`begin`, `drive`,
`respond`...) are generated from the catalogue at their first use, and again after it has grown.
"""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from op3.servo.effect import Effect, Stage, catalogue, type_hints
from op3.servo.machine_code import part
from op3.servo.signals import SIGNALS, Periods

BITS = 62
"""Effects per bit mask."""

HOOKS = ("prepare", "reset", "sense", "tick", "begin", "apply", "finish", "motor_side", "report", "balance")
"""Functions that an effect may have."""

RUNNERS: Mapping[str, tuple[str, str, Iterable[Stage]]] = {
    # name: function of the effects, arguments, stages
    "prepare": ("prepare", "p", Stage),
    "reset": ("reset", "s, p", Stage),
    "sense": ("sense", "s, p", Stage),
    "tick": ("tick", "s, p", Stage),
    "command": ("tick", "s, p", [Stage.COMMAND]),
    "begin": ("begin", "s, p", Stage),
    "drive": ("apply", "s, p", [stage for stage in Stage if stage < Stage.MOTOR]),
    "respond": ("apply", "s, p", [stage for stage in Stage if stage >= Stage.MOTOR]),
    "finish": ("finish", "s, p", Stage),
    "motor_side": ("motor_side", "s, p", Stage),
    "report": ("report", "s, p", Stage),
}
"""Functions that run for all effects in order; ``balance``, which runs backwards and passes on a torque, is separate.
"""


@dataclass(frozen=True, eq=False)
class Kernel:
    """The law of a catalogue.

    Attributes:
        effects: in the order in which they act.
        signals: type of the state of a joint.
        parameters: type of its parameters. One of its fields is named after a hash of all laws, so that cached code of
            other laws does not match.
        neutral: parameters where all effects are off.
        deep: effects with more memory than their fields.
        functions: runners by name.
    """

    effects: tuple[type[Effect], ...]
    signals: np.dtype
    parameters: np.dtype
    neutral: np.ndarray
    deep: tuple[str, ...]
    functions: Mapping[str, Any]

    def switches(self, effects: Sequence[Effect]) -> tuple[int, ...]:
        """Bit masks that switch on these effects.

        Raises:
            ValueError: if an effect is not in the catalogue.
        """
        words = [0] * (1 + (len(self.effects) - 1) // BITS)
        for effect in effects:
            if type(effect) not in self.effects:
                raise ValueError(f"{type(effect).__name__} is not in the catalogue; decorate the class with `register`")
        acting = {effect.acts_in or effect.name for effect in effects}
        for number, kind in enumerate(self.effects):
            words[number // BITS] |= (kind.name in acting) << number % BITS
        return tuple(words)

    def rows(self, effects: Sequence[Effect], clock: Periods, num_sims: int, num_joints: int) -> np.ndarray:
        """Parameters ``[sim, joint]``, with the options of active effects and neutral values for everything else."""
        made = np.repeat(np.repeat(self.neutral, num_sims, 0), num_joints, 1)
        made["timestep"], made["period"] = clock.timestep, clock.period
        for effect in effects:
            for option, value in _options(effect).items():
                made[option] = value
        return made


def current() -> Kernel:
    """The kernel of the current catalogue."""
    return _made(tuple(sorted(catalogue().values(), key=lambda effect: (effect.stage, effect.rank, effect.name))))


def __getattr__(name: str) -> Any:
    """A runner of the current kernel; compiled code looks it up here."""
    if name not in RUNNERS and name != "balance":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return current().functions[name]


@cache
def _made(effects: tuple[type[Effect], ...]) -> Kernel:
    fields, neutral = {"timestep": 0.0, "period": 0.0, f"law_{_text(effects)}": 0.0}, {}
    for effect in effects:
        neutral |= {p.name: p.nominal if p.neutral is None else p.neutral for p in effect.parameters}
        fields |= _options(effect()) | {f"{effect.name}_{name}": 0.0 for name in effect.constants}
    # what is compared or multiplied wherever it is off
    fields |= neutral | {"armature": 0.0}
    memory = [f"{effect.name}_{name}" for effect in effects for name in effect.memory]
    taken = [name for name in memory if name in SIGNALS]
    if taken:
        raise ValueError(f"memory {', '.join(taken)} has the name of a signal of the law; rename it")
    parameters = np.dtype([(name, np.float64) for name in fields])
    row = np.zeros((1, 1), parameters)
    for name, value in fields.items():
        row[name] = value
    deep = tuple(effect.name for effect in effects if effect.depth is not Effect.depth)
    signals = np.dtype([(name, np.float64) for name in (*SIGNALS, *memory)])
    return Kernel(effects, signals, parameters, row, deep, _functions(effects, deep))


def _options(effect: Effect) -> dict[str, float]:
    """Fields of the options; a named choice is its index."""
    hints, made = type_hints(type(effect)), {}
    for option in effect.options():
        value = getattr(effect, option)
        words = get_args(hints[option]) if getattr(hints[option], "__origin__", None) is Literal else ()
        made[f"{effect.name}_{option}"] = float(words.index(value) if words else value)
    return made


def _text(effects: Sequence[type[Effect]]) -> str:
    """Digest of the source files of the laws and of the kernel."""
    digest, frame = hashlib.sha256(), ("kernel.py", "law.py", "machine_code.py", "rows.py")
    files = {inspect.getsourcefile(effect) or effect.__module__ for effect in effects}
    for file in sorted(files | {str(Path(__file__).with_name(name)) for name in frame}):
        digest.update(Path(file).read_bytes() if Path(file).exists() else file.encode())
    return digest.hexdigest()[:12]


def _functions(effects: Sequence[type[Effect]], deep: Sequence[str]) -> dict[str, Any]:
    """The runners: a line per effect that has the function."""
    known: dict[str, Any] = {}
    for effect in effects:
        for hook in HOOKS:
            if getattr(effect, hook, None) is not None:
                known[f"{hook}_{effect.name}"] = part(getattr(effect, hook))
    lines = []
    for name, (hook, arguments, stages) in RUNNERS.items():
        remembers = hook in ("reset", "tick", "apply")
        lines.append(f"def {name}({arguments}{', past' if remembers else ''}, on):")
        for stage in stages:
            acting = [
                n for n, effect in enumerate(effects) if effect.stage == stage and f"{hook}_{effect.name}" in known
            ]
            if acting:  # a stage in which nothing is on costs one question
                lines.append(f"    if {_switched(acting)}:")
            for number in acting:
                effect = effects[number].name
                more = f", past[{deep.index(effect)}]" if remembers and effect in deep else ""
                lines.append(f"        if {_switched([number])}: {hook}_{effect}({arguments}{more})")
        lines.append("    return")
    lines.append("def balance(s, p, torque, rests, on):")
    for number, effect in reversed(list(enumerate(effects))):
        if f"balance_{effect.name}" in known:
            lines.append(f"    if {_switched([number])}: torque = balance_{effect.name}(s, p, torque, rests)")
    lines.append("    return torque")
    exec("\n".join(lines), known)
    return {name: part(known[name]) for name in (*RUNNERS, "balance")}


def _switched(numbers: Sequence[int]) -> str:
    """Source text of the test whether any of these effects is on."""
    words: dict[int, int] = {}
    for number in numbers:
        words[number // BITS] = words.get(number // BITS, 0) | 1 << number % BITS
    return " or ".join(f"on[{word}] & {bits}" for word, bits in words.items())
