"""Optuna's samplers by short names, configured for populations.

A study builds a fresh sampler for every population, seeded by the study's seed and the number of finished trials. The
next population therefore depends only on the stored trials, and a resumed study continues like an uninterrupted one.
This requires samplers that store their state in the trials, as all samplers in this module do.
"""

import functools
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import optuna
from optuna.samplers import BaseSampler, nsgaii

from op3.identify.level_set_sampler import LevelSetSampler
from op3.identify.search_space import StudyError

SamplerFactory = Callable[[int], BaseSampler]
"""Builds the sampler of one population from its seed."""


_BY_NAME: Mapping[str, type[BaseSampler]] = {
    "tpe": optuna.samplers.TPESampler,
    "cmaes": optuna.samplers.CmaEsSampler,
    "nsga2": optuna.samplers.NSGAIISampler,
    "nsga2+surrogate": LevelSetSampler,
    "random": optuna.samplers.RandomSampler,
}


def make_sampler_factory(
    sampler: str | Mapping[str, Any],
    *,
    population: int,
    directions: int = 1,
    nominal: Mapping[str, Any] | None = None,
) -> SamplerFactory:
    """Choose the sampler that proposes new parameters.

    Args:
        sampler: a name (`tpe`, `cmaes`, `nsga2`, `nsga2+surrogate`, `random`), or `{name: tpe, **options}`.
        population: number of trials requested at once. CMA-ES and NSGA-II use 7/8 of it as a generation, so that a few
            failed trials do not delay a generation.
        directions: number of objectives.
        nominal: the nominal parameters, where CMA-ES starts.

    Raises:
        StudyError: if the name or an option is unknown, or the sampler does not fit the study.
    """
    options = {"name": sampler} if isinstance(sampler, str) else {str(key): sampler[key] for key in sampler}
    options.pop("seed", None)
    name = str(options.pop("name", ""))
    if name not in _BY_NAME:
        raise StudyError(f"The sampler {name!r} is unknown: use one of {', '.join(_BY_NAME)}.")
    if directions > 1 and name == "cmaes":
        raise StudyError(f"The sampler {name!r} takes one objective, but the study has {directions}: use nsga2.")
    factory = functools.partial(_build, _BY_NAME[name], _defaults(name, population, nominal) | options)
    try:
        factory(0)
    except (TypeError, ValueError, ImportError) as error:
        raise StudyError(f"The sampler {name!r} does not accept these options: {error}.") from error
    return factory


def _build(build: Callable[..., BaseSampler], options: Mapping[str, Any], seed: int) -> BaseSampler:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        # CmaEsSampler's x0 is deprecated without a replacement for the version that this project is pinned to
        warnings.filterwarnings("ignore", message=".*`x0` has been deprecated.*", category=FutureWarning)
        made = {key: value() if isinstance(value, type) else value for key, value in options.items()}
        return build(seed=seed, **made)


def _defaults(name: str, population: int, nominal: Mapping[str, Any] | None) -> dict[str, Any]:
    """Default options of a sampler."""
    generation = max(2, population - population // 8)
    if name == "tpe":
        # Multivariate TPE models the parameters together and costs a third of the default. Penalising the points of the
        # same population (constant_liar) found no better values on an 11-parameter quadratic with populations of 64.
        return {"multivariate": True, "constant_liar": False}
    if name == "cmaes":
        # With fewer than 5, cmaes has hardly any selection; None lets it choose from the dimension.
        popsize = generation if population >= 6 else None
        return {"x0": dict(nominal) if nominal else None, "popsize": popsize, "warn_independent_sampling": False}
    if name.startswith("nsga2"):
        # the real-coded operators of Deb et al. (2002)
        operators = {"crossover": nsgaii.SBXCrossover, "mutation": nsgaii.PolynomialMutation}
        size = {"population_size": generation if population >= 16 else 50}
        return operators | size | ({"proposals": population // 2} if name == "nsga2+surrogate" else {})
    return {}
