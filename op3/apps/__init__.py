"""The commands as typed functions; each returns a result object with everything that the command prints.

    from op3.apps.collect import collect
    from op3.apps.identify import identify

    squat = collect("squat", source="stand_in", world="eta_070")
    identified = identify(squat.folders, method="lsq")
    print(identified.headline, identified.model)

Each module has a function of the same name, for Python, and a Hydra `main`, which ``op3 <command>`` and ``python
experiments/<name>.py`` call. Both read ``conf/<name>.yaml``.
"""

from collections.abc import Mapping

COMMANDS: Mapping[str, str] = {
    "demo": "sim2real",
    "demo diagnose": "demo_diagnose",
    "collect": "collect",
    "check": "check",
    "import": "import_log",
    "identify": "identify",
    "predict": "predict",
    "export": "export",
    "diagnose": "diagnose",
    "design": "design_excitation",
    "train": "train",
    "evaluate": "evaluate",
    "compliance": "compliance",
    "deploy": "deploy",
    "reidentify": "reidentify",
    "sim2real": "sim2real",
    "transfers": "transfer_table",
    "view": "view",
    "emulate": "emulate_robot",
    "compare": "compare_runs",
}
"""Module in `op3.apps`, and config, by command."""
