"""Many robots with one task, stepped together: a natively batched TorchRL environment."""

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from math import inf
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from op3.common.settings import CONTROL_PERIOD
from op3.envs.specs import as_tensordict, set_specs
from op3.policy import ActionMap
from op3.policy.forward_kinematics import PROCESSOR
from op3.robot import load_robot
from op3.scenes import build_scene, tile_ids
from op3.servo import RobotModel
from op3.sim import BatchSimulation, attach_servos
from op3.sim.batch_simulation import torch_view
from op3.tasks.episodes import World, episode_seed
from op3.tasks.mdp import Mdp
from op3.tasks.snapshot import Probe, Snapshot, to_device
from op3.tasks.task import POLICY_PERIOD, TICKS, Task
from op3.tasks.whole_step import WholeStep


class BatchedEnv(EnvBase):
    """``num_envs`` robots with one task, each with separate ground and parameters.

    A step is 32 ms: four ticks of the PD and 32 steps of the physics. Resets do not affect other robots, and the k-th
    episode of robot i depends only on the seed, i and k.

    Args:
        model: effects and parameter values of the robots.
        parameters: values by parameter name, ``[num_envs]`` or ``[num_envs, joint]`` or a number, which replace the
            model's permanently.
        gain_scale: factor on all commanded P and D gains, which emulates stronger or weaker servos.
        timestep: time step of the physics [s]; None: that of the scene, 1 ms.
        num_threads: threads that step the physics; 0 for all processors.
        device: device of terms, observations and rewards; the physics stays on the CPU.

    Raises:
        ValueError: if a term of the task is invalid, a parameter is unknown, or one in `parameters` is also drawn.
        MemoryError: if there are too many robots.
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
        gain_scale: float = 1.0,
        timestep: float | None = None,
        num_threads: int = 0,
        device: torch.device | str = "cpu",
    ):
        super().__init__(device=torch.device(device), batch_size=torch.Size([num_envs]))
        if not 0 < gain_scale < inf:
            raise ValueError(f"gain_scale must be a number above 0, got {gain_scale}")
        self.task, self.model = task, model
        self.action_map = action_map or task.action_map()
        self._gain_scale, self._num_envs, self._num_threads = gain_scale, num_envs, num_threads
        self.scene = build_scene(task.scene, robot=load_robot(task.robot))
        attach_servos(self.scene.joints)
        try:
            with self._on_device():
                self.mdp = Mdp(task, self.scene, model, self.action_map, num_envs)
        except (RuntimeError, ValueError) as error:
            if "can't allocate memory" in str(error):  # torch has no specific error for this on CPUs
                raise MemoryError(f"not enough memory for {num_envs} robots") from None
            raise
        drawn = self.mdp.event("randomisation")
        self.parameters_drawn: dict[str, Tensor] = {} if drawn is None else drawn.drawn
        """Drawn parameter values of the current episodes, by parameter, ``[num_envs]``."""
        self._fixed = dict(parameters or {})
        if clash := sorted(set(self.parameters_drawn) & set(self._fixed)):
            raise ValueError(f"parameter {clash[0]!r} is both set and randomised; remove one of the two")
        self.timestep = self._simulate(timestep)
        self.episode_seeds = np.zeros(num_envs, dtype=np.int64)
        self.commander: Any = None
        """Object that commands the servos at every tick, such as `op3.tasks.StiffWalk`; None: the actions do."""
        self.on_tick: Callable[[int], None] | None = None
        """Called before each tick with its number within the step, for recorders."""
        set_specs(self, self.mdp)
        self.set_seed(seed)

    def _simulate(self, timestep: float | None) -> float:
        """Create the simulation and look up its arrays; return the time step of the physics [s]."""
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
            control_period=CONTROL_PERIOD,
            base_body=None if robot.robot.file.base is None else robot.trunk.full_identifier,
            num_threads=self._num_threads,
        )
        batch, with_feet = self.simulation.batch, self.task.gait is not None
        self._qpos, self._qvel, self._sites = (batch.bind(name) for name in ("qpos", "qvel", "site_xpos"))
        self._bodies = batch.bind("xpos"), batch.bind("xquat")
        self._sensordata = self.simulation.sensordata
        self._probe = Probe(batch.model, self.scene, with_feet)
        self._whole_step = WholeStep(batch.model, self.scene, self._num_envs, with_feet)
        self.simulation.on_step = self._look
        base = batch.model.body(robot.trunk.full_identifier).id
        self.mdp.attach(
            World(
                model=batch.model,
                qpos=self._qpos,
                qvel=self._qvel,
                qfrc_applied=batch.bind("qfrc_applied"),
                base_wrench=batch.bind("xfrc_applied")[:, base],
                geom_pos=batch.expand("geom_pos") if len(tile_ids(batch.model)) else None,
                set_parameters=lambda _: self.set_parameters(self._fixed),
            )
        )
        if self._fixed:
            self.simulation.set_parameters(self._fixed)
        return self.simulation.timestep

    @property
    def num_envs(self) -> int:
        """Number of robots."""
        return self._num_envs

    @property
    def policy_period(self) -> float:
        """Time between steps [s]."""
        return POLICY_PERIOD

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
        return self._begin(seeds)

    def begin(self, episodes: Mapping[int, int]) -> TensorDict:
        """Start given episodes in some robots; an episode has the same initial state in every robot.

        Args:
            episodes: episode numbers by index of the robot; other robots continue.

        Returns:
            The state of all robots, as `reset` gives it.
        """
        return self._begin({row: episode_seed(self.seed, 0, number) for row, number in episodes.items()})

    def set_terms(self, timestep: float | None = None, **values: float) -> None:
        """Change parameters of the task's terms, as curricula do.

        Args:
            timestep: time step of the physics [s], from the next reset of all robots on; None: unchanged.
            **values: values by path, see `op3.tasks.mdp.Mdp.set`. Values that are drawn when an episode begins change
                for the following episodes.
        """
        self.timestep = self.timestep if timestep is None else timestep
        for path, value in values.items():
            self.mdp.set(path, value)

    def set_parameters(self, values: Mapping[str, Tensor | float]) -> None:
        """Set other robot parameters, like the constructor's `parameters`."""
        self._fixed = dict(values)
        joints = self.scene.joint_names
        drawn = {
            name: self.model.for_joints(name, value.cpu(), joints) for name, value in self.parameters_drawn.items()
        }
        self.simulation.set_parameters({**self._fixed, **drawn})

    def _begin(self, seeds: Mapping[int, int]) -> TensorDict:
        rows = np.array(sorted(seeds), dtype=np.int64)
        drawn = np.array([seeds[int(row)] for row in rows], dtype=np.int64)
        self.episode_seeds[rows] = drawn
        with self._on_device():
            episodes = self.mdp.begin(rows, drawn)
        commands = self._scaled(self.mdp.resting_commands(len(rows)))
        every = len(rows) == self.num_envs
        self.simulation.reset(episodes.qpos, commands, episodes.qvel, rows=None if every else rows)
        with self._on_device():
            return as_tensordict(self.mdp, self.mdp.begun(self._to_device(self.snapshot())))

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        action = tensordict["action"].double()
        self.simulation.command(**self._scaled(self.action_map.commands(action)))
        time = self.mdp.time.cpu().numpy()
        self._whole_step.begin(self._sites)
        for tick in range(TICKS):
            now = time + tick * CONTROL_PERIOD
            if self.commander is not None:
                self.simulation.command(**self.commander.commands(torch.from_numpy(now)))
            if self.on_tick is not None:
                self.on_tick(tick)
            self.mdp.tick(now)
            self.simulation.advance()
        statistics = self._whole_step.result()
        with self._on_device():
            measured = map(self._to_device, (self.snapshot(), statistics, self.simulation.failed))
            outcome = self.mdp.finish(action, *measured)
            return as_tensordict(self.mdp, outcome.observation, outcome, statistics)

    def _scaled(self, commands: dict[str, Tensor]) -> dict[str, Tensor]:
        """Commands for the servos, on the CPU."""
        scale = self._gain_scale
        return {name: (value * scale if "gain" in name else value).cpu() for name, value in commands.items()}

    def _on_device(self) -> AbstractContextManager:
        """Context in which new tensors are on the environment's device."""
        return nullcontext() if self.device == PROCESSOR else self.device

    def _to_device(self, measured: Any) -> Any:
        """A tensor, or an object of tensors, of the simulation on the environment's device."""
        return measured if self.device == PROCESSOR else to_device(measured, self.device)

    def _look(self) -> None:
        simulation = self.simulation
        self._whole_step.look(self._qpos, self._qvel, self._sensordata.numpy(), self._sites, simulation.motor_current)

    def snapshot(self) -> Snapshot:
        """A snapshot of the robots."""
        arrays = (self._qpos, self._qvel, *self._bodies, self._sites)
        qpos, qvel, place, turn, sites = map(torch_view, arrays)
        return self._probe.read(qpos, qvel, self._sensordata, (place, turn), sites, self.simulation.measure())
