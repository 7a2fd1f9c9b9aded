"""Optuna's samplers by plain names, set up for populations.

A study builds a fresh sampler for every population, seeded by the study's seed and the number of
finished trials. So the next population depends on the stored trials alone: a resumed study goes on
exactly where an uninterrupted one would have gone, and never repeats its first points. This needs a
sampler that keeps what it learns in the trials, as all those below do.
"""

import functools
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import optuna
from optuna.samplers import BaseSampler, nsgaii

from op3.identify.level_set_sampler import LevelSetSampler

SamplerFactory = Callable[[int], BaseSampler]
"""Makes the sampler of one population from its seed."""


class SamplerError(ValueError):
    """A sampler that cannot be used; the message says why and what to write instead."""


_STATEFUL = (optuna.samplers.QMCSampler, optuna.samplers.GridSampler, optuna.samplers.BruteForceSampler)


def make_sampler_factory(
    sampler: str | Mapping[str, Any] | SamplerFactory,
    *,
    population: int,
    directions: int = 1,
    nominal: Mapping[str, Any] | None = None,
) -> SamplerFactory:
    """Choose how new parameters are proposed.

    Args:
        sampler: a name (`tpe`, `cmaes`, `nsga2`, `nsga2+surrogate`, `gp`, `random`); a mapping
            `{name: tpe, **options}` or `{_target_: optuna.samplers.TPESampler, **options}`; or a function from a seed
            to a sampler. The options `crossover` (uniform, blx, sbx, spx, undx, vsbx) and `mutation` (polynomial) of
            nsga2 may be names.
        population: how many trials are asked at once. CMA-ES and NSGA-II take a generation of 7/8 of it,
            so that a few failed trials do not cost a generation.
        directions: number of objectives.
        nominal: the nominal parameters, where CMA-ES starts if all of them are numbers.

    Returns:
        A function from a seed to a sampler.

    Raises:
        SamplerError: if the name or an option is unknown, or the sampler does not fit the study.
    """
    if callable(sampler):
        return sampler
    options = {"name": sampler} if isinstance(sampler, str) else {str(key): sampler[key] for key in sampler}
    options.pop("seed", None)
    target, name = options.pop("_target_", None), options.pop("name", None)
    if target is not None:
        build, name = _locate(target), str(target)
    elif name in _BY_NAME:
        build, defaults = _BY_NAME[name]
        options = {**defaults(population, nominal), **options}
    else:
        raise SamplerError(
            f"The sampler {name!r} is unknown: use one of {', '.join(_BY_NAME)}, "
            "or {_target_: optuna.samplers.<class>}."
        )
    if directions > 1 and build in (optuna.samplers.CmaEsSampler,):
        raise SamplerError(f"The sampler {name!r} takes one objective, the study has {directions}: use nsga2.")
    for kind, known in _OPERATORS.items():
        if isinstance(options.get(kind), str):
            if options[kind] not in known:
                raise SamplerError(f"The {kind} {options[kind]!r} is unknown: use one of {', '.join(known)}.")
            options[kind] = _quiet(known[options[kind]])
    factory = functools.partial(_build, build, options)
    try:
        factory(0)
    except (TypeError, ValueError, ImportError) as error:
        raise SamplerError(f"The sampler {name!r} does not take these options: {error}.") from error
    return factory


def _build(build: Callable[..., BaseSampler], options: Mapping[str, Any], seed: int) -> BaseSampler:
    return _quiet(functools.partial(build, seed=seed, **options))


def _quiet(make: Callable[[], Any]) -> Any:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        # CmaEsSampler's x0 is deprecated without a replacement for the version that this project is pinned to
        warnings.filterwarnings("ignore", message=".*`x0` has been deprecated.*", category=FutureWarning)
        return make()


def _locate(target: Any) -> Callable[..., BaseSampler]:
    name = str(target).removeprefix("optuna.samplers.")
    found = getattr(optuna.samplers, name, None)
    if not (isinstance(found, type) and issubclass(found, BaseSampler)):
        raise SamplerError(f"The sampler {target!r} is not a class of optuna.samplers.")
    if found in _STATEFUL:
        raise SamplerError(
            f"{name} counts its points outside the trials, so it would repeat them: use one of {', '.join(_BY_NAME)}."
        )
    return found


class _PopulationTPE(optuna.samplers.TPESampler):
    """TPE that fits its densities once for a population, whose trials are all asked of the same finished ones.

    It asks the same trials as Optuna's, in half the time. Where Optuna renames what is overridden, it is Optuna's.
    """

    def __init__(self, **options: Any):
        super().__init__(**options)
        self._fitted: dict[tuple[Any, ...], Any] = {}

    def _build_parzen_estimator(self, study: Any, search_space: Any, trials: Any, handle_below: bool) -> Any:
        key = (handle_below, tuple(search_space), tuple(trial.number for trial in trials))
        if key not in self._fitted:
            self._fitted[key] = super()._build_parzen_estimator(study, search_space, trials, handle_below)
        return self._fitted[key]


def _generation(population: int) -> int:
    return max(2, population - population // 8)


def _no_defaults(population: int, nominal: Mapping[str, Any] | None) -> dict[str, Any]:
    return {}


def _tpe_defaults(population: int, nominal: Mapping[str, Any] | None) -> dict[str, Any]:
    # Multivariate TPE models the parameters together and costs a third of the default. Penalising the
    # points of the same population (constant_liar) found nothing better on an 11-parameter bowl with
    # populations of 64, and costs a fifth more.
    return {"multivariate": True, "constant_liar": False}


def _cmaes_defaults(population: int, nominal: Mapping[str, Any] | None) -> dict[str, Any]:
    numbers = nominal and all(isinstance(v, int | float) and not isinstance(v, bool) for v in nominal.values())
    # Below 5, cmaes has no selection to speak of; None lets it choose by the dimension.
    popsize = _generation(population) if population >= 6 else None
    return {
        "x0": dict(nominal) if nominal and numbers else None,
        "popsize": popsize,
        "warn_independent_sampling": False,
    }


def _nsga2_defaults(population: int, nominal: Mapping[str, Any] | None) -> dict[str, Any]:
    return {"population_size": _generation(population) if population >= 16 else 50}


def _level_set_defaults(population: int, nominal: Mapping[str, Any] | None) -> dict[str, Any]:
    return {**_nsga2_defaults(population, nominal), "proposals": population // 2}


def _gp_defaults(population: int, nominal: Mapping[str, Any] | None) -> dict[str, Any]:
    return {"warn_independent_sampling": False}


_OPERATORS: Mapping[str, Mapping[str, Callable[[], Any]]] = {
    "crossover": {
        "uniform": nsgaii.UniformCrossover,
        "blx": nsgaii.BLXAlphaCrossover,
        "sbx": nsgaii.SBXCrossover,
        "spx": nsgaii.SPXCrossover,
        "undx": nsgaii.UNDXCrossover,
        "vsbx": nsgaii.VSBXCrossover,
    },
    "mutation": {"polynomial": nsgaii.PolynomialMutation},
}
"""Operators of NSGA-II by the names that a config may give."""

_Defaults = Callable[[int, Mapping[str, Any] | None], dict[str, Any]]
_BY_NAME: dict[str, tuple[Callable[..., BaseSampler], _Defaults]] = {
    "tpe": (_PopulationTPE, _tpe_defaults),
    "cmaes": (optuna.samplers.CmaEsSampler, _cmaes_defaults),
    "nsga2": (optuna.samplers.NSGAIISampler, _nsga2_defaults),
    "nsga2+surrogate": (LevelSetSampler, _level_set_defaults),
    "gp": (optuna.samplers.GPSampler, _gp_defaults),
    "random": (optuna.samplers.RandomSampler, _no_defaults),
}
