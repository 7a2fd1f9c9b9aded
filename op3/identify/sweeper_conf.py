"""Hydra's config of the sweeper, in a separate module so that a config can be composed without importing a study."""

from dataclasses import dataclass, field
from typing import Any


@dataclass
class PopulationSweeperConf:
    """Settings of the sweeper, in Hydra's config under `hydra.sweeper`."""

    _target_: str = "hydra_plugins.op3_population_sweeper.PopulationSweeper"
    # op3 builds the sampler, once for every population.
    _recursive_: bool = False
    # tpe, cmaes, nsga2, nsga2+surrogate, random; {name: tpe, **options}
    sampler: Any = "tpe"
    # minimize or maximize; a list for several objectives
    direction: Any = "minimize"
    # a path ending in .journal, or a database URL; null: study.journal in the folder of the run or cell
    storage: str | None = None
    # null: "study"; names of grid cells that share a storage include their overrides
    study_name: str | None = None
    # finished trials of each study, over all its workers
    n_trials: int = 256
    # trials that one job evaluates together
    population: int = 64
    # jobs launched together, for launchers that run jobs in parallel
    parallel_populations: int = 1
    # number of this process if several share a study's storage
    worker: int = 0
    # whether the config's values are the first trial
    nominal: bool = True
    # trials that the experiment proposes between that one and the sampler's trials; 0: none
    starts: int = 0
    # null: redrawn for each new study
    seed: int | None = None
    # config key -> range, such as interval(0.003, 0.009)
    params: dict[str, Any] = field(default_factory=dict)
    # config key -> labels: the key is searched as <key>@joint=<label> for each, starting from the key's value
    each: Any = None
