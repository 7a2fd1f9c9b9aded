"""Where Hydra finds the sweeper of populations, whose work `op3.identify.sweeper` does; every command imports this."""

from typing import Any

from hydra.errors import CompactHydraException
from hydra.plugins.sweeper import Sweeper


class PopulationSweeper(Sweeper):
    """Imports the study's libraries once a sweep begins."""

    def __init__(self, **settings: Any) -> None:
        """Settings are read from every cell's own config, where groups may change them."""

    def setup(self, **hydra: Any) -> None:
        """Take over Hydra's objects and make the launcher."""
        from op3.identify.sweeper import PopulationSweep

        self._sweep = PopulationSweep(**hydra)

    def sweep(self, arguments: list[str]) -> Any:
        """Run all cells; return the job that reported each. A wrong setting is printed without a stack trace."""
        try:
            return self._sweep.run(arguments)
        except ValueError as error:
            raise CompactHydraException(str(error)) from error
