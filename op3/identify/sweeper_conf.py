"""Hydra's config of the sweeper, in a separate module so that a config is composed before a study is imported."""

from dataclasses import dataclass, field
from typing import Any


@dataclass
class PopulationSweeperConf:
    """Settings of the sweeper, in Hydra's config under `hydra.sweeper`."""

    _target_: str = "hydra_plugins.op3_population_sweeper.PopulationSweeper"
    # The sampler is built by us, once for every population.
    _recursive_: bool = False
    # tpe, cmaes, nsga2, nsga2+surrogate, random; {name: tpe, **options}
    sampler: Any = "tpe"
    # minimize or maximize; a list for several objectives
    direction: Any = "minimize"
    # a path ending in .journal, or a database URL; null: study.journal in the folder of the run or cell
    storage: str | None = None
    # null: "study"; cells of a grid that share a storage get their overrides appended
    study_name: str | None = None
    # finished trials of each study, over all its workers
    n_trials: int = 256
    # trials asked together and evaluated by one job
    population: int = 64
    # jobs launched together, for launchers that run jobs side by side
    parallel_populations: int = 1
    # number of this process where several share a study's storage
    worker: int = 0
    # whether the config's own values are the first trial
    nominal: bool = True
    # trials that the experiment itself proposes after that, before the sampler; 0: none
    starts: int = 0
    # null: redrawn for each new study
    seed: int | None = None
    # config key -> range, such as interval(0.003, 0.009)
    params: dict[str, Any] = field(default_factory=dict)
    # config key -> labels: what is searched once for each, as <key>@joint=<label>, from the key's own value
    each: Any = None
