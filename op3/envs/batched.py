"""Many robots at a task, stepped together: a natively batched TorchRL environment."""

from collections.abc import Callable, Mapping
from math import inf
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from op3.envs.specs import answer, set_specs
from op3.policy import ActionMap
from op3.robot import board_drive, build_scene, place_tiles, stack, tile_ids
from op3.servo import RobotModel
from op3.sim import BatchSimulation, attach_servos
from op3.tasks.beginning import Beginning, begin, episode_seed
from op3.tasks.pushes import Pushes
from op3.tasks.randomisation import Randomisation
from op3.tasks.rules import Rules
from op3.tasks.setups import OP3_CONTROL_PERIOD
from op3.tasks.snapshot import Probe, Snapshot
from op3.tasks.task import POLICY_PERIOD, TICKS, Task, find_task
from op3.tasks.whole_step import WholeStep


class BatchedEnv(EnvBase):
    """``num_envs`` robots at one task, each on a ground and with parameters of its own.

    A step is 32 ms: four ticks of the PD and 32 steps of the physics. Robots that are reset do not disturb the others,
    and the k-th episode of robot i depends on the seed, i and k alone.

    Args:
        model: effects and parameter values of the robots.
        parameters: values by parameter name, ``[num_envs]`` or ``[num_envs, joint]`` or a number, that replace the
            model's for good.
        randomisation: draws each robot's parameters anew for every episode; None: they stay.
        gain_scale: factor on every P and D gain that is commanded, as of servos stronger or weaker than they are known.
        timestep: of the physics [s]; None: that of the scene, 1 ms.
        num_threads: threads that step the physics; 0 for all processors.

    Raises:
        ValueError: if a parameter is unknown, or one that `parameters` gives is also drawn.
    """

    def __init__(
        self,
        task: Task,
        model: RobotModel,
        num_envs: int = 64,
        seed: int = 0,
        *,
        action_map: ActionMap | None = None,
        parameters: Mapping[str, Tensor | float] | None = None,
        randomisation: Randomisation | None = None,
        gain_scale: float = 1.0,
        timestep: float | None = None,
        num_threads: int = 0,
    ):
        super().__init__(device=torch.device("cpu"), batch_size=torch.Size([num_envs]))
        self.task, self.model = task, model
        self.action_map = action_map or ActionMap.around_stand()
        if not 0 < gain_scale < inf:
            raise ValueError(f"gain_scale must be a number above 0, got {gain_scale}")
        self._gain_scale = gain_scale
        self.scene = build_scene(task.scene)
        attach_servos(self.scene.joints)
        self._num_envs, self._num_threads = num_envs, num_threads
        self._randomisation = randomisation
        self._drawn = {} if randomisation is None else randomisation.bounds(model)
        self._fixed = dict(parameters or {})
        clash = sorted(set(self._drawn) & set(self._fixed))
        if clash:
            raise ValueError(f"parameter {clash[0]!r} is both given and drawn; name it in one place")
        self.parameters_drawn = {name: torch.zeros(num_envs, dtype=torch.float64) for name in self._drawn}
        self.timestep = self._simulate(timestep)
        self._beginnings: dict[int, Beginning] = {}
        self.rules = Rules(task, self.action_map, num_envs)
        self._beginning_task = task
        self._board: Any = None
        self.pushes: Pushes | None = None
        """What pushes the trunks; those of the episodes, unless others are set after a reset."""
        self.episode_seeds = np.zeros(num_envs, dtype=np.int64)
        self.commander: Any = None
        """Commands the servos itself at every tick, as `op3.tasks.StiffWalk` does; None: the actions do."""
        self.on_tick: Callable[[int], None] | None = None
        """Called with the number of the tick in the step, before it; a recorder looks at the robots here."""
        set_specs(self, task, self.action_map, num_envs)
        self.set_seed(seed)

    def _simulate(self, timestep: float | None) -> float:
        """Make the simulation and look into its arrays; returns the time step of the physics [s]."""
        robot = self.scene.robot
        assert robot is not None
        compiled = self.scene.compile(visual=False)
        if timestep is not None:
            compiled.opt.timestep = timestep
        self.simulation = BatchSimulation(
            compiled,
            self.scene.joint_names,
            self.model,
            self._num_envs,
            control_period=OP3_CONTROL_PERIOD,
            base_body=robot.trunk.full_identifier,
            num_threads=self._num_threads,
        )
        batch = self.simulation.batch
        self._qpos, self._qvel = batch.bind("qpos"), batch.bind("qvel")
        self._forces = batch.bind("qfrc_applied")
        with_feet = self.task.cycle is not None
        self._probe = Probe(batch.model, self.scene, with_feet)
        self._sensordata = self.simulation.sensordata
        self._whole_step = WholeStep(batch.model, self.scene, self._num_envs, with_feet)
        self._sites = batch.bind("site_xpos")
        self.simulation.on_step = self._look
        self._tiles = tile_ids(batch.model)
        self._geom_pos = batch.expand("geom_pos") if len(self._tiles) else None
        self._trunk = batch.bind("xfrc_applied")[:, batch.model.body(robot.trunk.full_identifier).id]
        if self._fixed:
            self.simulation.set_parameters(self._fixed)
        return self.simulation.timestep

    @property
    def num_envs(self) -> int:
        """Number of robots."""
        return self._num_envs

    def _set_seed(self, seed: int | None) -> None:
        self.seed = 0 if seed is None else int(seed)
        self._episodes = np.zeros(self.num_envs, dtype=np.int64)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDict:
        mask = torch.ones(self.num_envs, dtype=torch.bool)
        if tensordict is not None and tensordict.get("_reset", None) is not None:
            mask = tensordict["_reset"].view(self.num_envs)
        if self.timestep != self.simulation.timestep and bool(mask.all()):
            self._simulate(self.timestep)
        rows = mask.nonzero()[:, 0].tolist()
        seeds = {row: episode_seed(self.seed, row, int(self._episodes[row])) for row in rows}
        self._episodes[rows] += 1
        return self._begin(mask, seeds)

    def begin(self, episodes: Mapping[int, int]) -> TensorDict:
        """Put some robots down for chosen episodes, in which all robots find the same beginning.

        Args:
            episodes: number of the episode, by index of the robot; the others go on undisturbed.

        Returns:
            The state of all robots, as `reset` gives it.
        """
        mask = torch.zeros(self.num_envs, dtype=torch.bool)
        mask[list(episodes)] = True
        return self._begin(mask, {row: episode_seed(self.seed, 0, number) for row, number in episodes.items()})

    def practise(
        self, speed_bonus: float = 0.0, largest_lag: float = inf, timestep: float | None = None, **task: float
    ) -> None:
        """What learning begins with and grows out of.

        Args:
            speed_bonus: see `op3.tasks.rules.Rules`.
            timestep: of the physics [s], from when all robots begin together the next time; None: as it is.
            **task: numbers of the task, such as `terrain_height`, for the episodes that begin from now on.
        """
        self.rules.speed_bonus, self.rules.largest_lag = speed_bonus, largest_lag
        self.timestep = self.timestep if timestep is None else timestep
        self._beginning_task = find_task(self.task, **task)

    def set_parameters(self, values: Mapping[str, Tensor | float]) -> None:
        """Give robots other parameters from now on, as the constructor's `parameters`."""
        self._fixed = dict(values)
        self.simulation.set_parameters({**self._fixed, **self._drawn_values()})

    def _drawn_values(self) -> dict[str, Tensor]:
        """What has been drawn, by joint where the model has joints that differ."""
        joints = self.scene.joint_names
        return {name: self.model.for_joints(name, value, joints) for name, value in self.parameters_drawn.items()}

    def _begin(self, mask: Tensor, seeds: Mapping[int, int]) -> TensorDict:
        rows = np.array(sorted(seeds))
        for row, seed in seeds.items():
            self.episode_seeds[row] = seed
            self._beginnings[row] = begin(self._beginning_task, self.scene, seed)
        self._place(rows)
        phase = torch.tensor([self._beginnings[row].phase for row in range(self.num_envs)], dtype=torch.float64)
        return answer(self.task, self.rules.begin(self.snapshot(), mask, phase))

    def _place(self, rows: np.ndarray) -> None:
        """Put robots at their beginnings, on their grounds, with their parameters."""
        chosen = [self._beginnings[row] for row in rows]
        if self._randomisation is not None:
            for row in rows:
                drawn = self._randomisation.draw(self.model, int(self.episode_seeds[row]))
                for name, value in drawn.items():
                    self.parameters_drawn[name][row] = value
            self.simulation.set_parameters({**self._fixed, **self._drawn_values()})
        if self._geom_pos is not None:
            heights = [self._beginnings[row].tiles for row in range(self.num_envs)]
            place_tiles(self._geom_pos, self._tiles, np.stack([h for h in heights if h is not None]))
        qpos, qvel = (np.stack([getattr(b, name) for b in chosen]) for name in ("qpos", "qvel"))
        commands = self._scaled(self.rules.resting_commands(len(rows)))
        self.simulation.reset(qpos, commands, qvel, rows=None if len(rows) == self.num_envs else rows)
        if self.task.board is not None:
            motions: list[Any] = [self._beginnings[row].board for row in range(self.num_envs)]
            if self._board is None:
                self._drive: Any = board_drive(self.simulation.batch.model, motions[0], OP3_CONTROL_PERIOD)
            self._board = stack(motions)
        if self.task.push:
            pushes = [beginning.push for beginning in chosen if beginning.push is not None]
            if self.pushes is None:  # all robots begin together the first time
                self.pushes = Pushes(pushes)
            else:
                self.pushes.replace(rows, pushes)

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        action = tensordict["action"].double()
        self.simulation.command(**self._scaled(self.action_map.commands(action)))
        time = self.rules.time.numpy()
        self._whole_step.begin(self._sites)
        for tick in range(TICKS):
            now = time + tick * OP3_CONTROL_PERIOD
            if self.commander is not None:
                self.simulation.command(**self.commander.commands(torch.from_numpy(now)))
            if self.on_tick is not None:
                self.on_tick(tick)
            if self.pushes is not None:
                self.pushes.drive(now, self._trunk)
            if self._board is not None:
                self._drive.apply(self._board, now, self._qpos, self._qvel, self._forces)
            self.simulation.advance()
        throughout = self._whole_step.result()
        outcome = self.rules.finish(action, self.snapshot(), throughout, self.simulation.failed)
        return answer(self.task, outcome.observation, outcome, throughout)

    def _scaled(self, commands: dict[str, Tensor]) -> dict[str, Tensor]:
        """Commands as the servos get them."""
        if self._gain_scale == 1.0:
            return commands
        return {name: value * self._gain_scale if "gain" in name else value for name, value in commands.items()}

    def _look(self) -> None:
        simulation = self.simulation
        self._whole_step.look(self._qpos, self._qvel, self._sensordata.numpy(), self._sites, simulation.motor_current)

    def snapshot(self) -> Snapshot:
        """The robots now."""
        simulation = self.simulation
        return self._probe.read(
            torch.from_numpy(self._qpos), torch.from_numpy(self._qvel), self._sensordata, simulation.measure()
        )

    @property
    def policy_period(self) -> float:
        """Time between steps [s]."""
        return POLICY_PERIOD
