"""Identify the squat with MuJoCo's toolbox `mujoco.sysid`, as far as its model allows, and with `method=lsq`.

python experiments/benchmarks/sysid_peer.py data=<squat log> heldout=<another> [iterations=30]

The toolbox needs `pip install "mujoco[sysid]"`. Its model: one affine actuator per joint, torque = 353.5 Kt
(Kp (q* - q) - Kd w), with armature, damping and friction loss of the joint, and mass and centre of mass of the trunk;
seven parameters. MuJoCo has no gear whose losses depend on direction and no static friction besides friction loss, and
its actuator includes neither battery nor latency. Both models are fitted to joint angles and velocities only, from the
paper's nominal values, and compared by the mean absolute angle error of open-loop replays.
"""

import time
from pathlib import Path
from typing import Any

import hydra
import mujoco
import numpy as np
import torch
from hydra.core.hydra_config import HydraConfig
from mujoco import sysid
from omegaconf import DictConfig

from op3.apps.fields import plain
from op3.apps.job import one_sentence
from op3.identify.identification import PREFIX, Identification
from op3.identify.loss import TrajectoryLoss
from op3.identify.search_space import parse_search_space
from op3.identify.study import StudySettings, run_study
from op3.report import Page, run_provenance, write_result
from op3.robot import load_robot
from op3.rollout import Rollout, read_logs
from op3.scenes import build_scene
from op3.sim import load_model

PEER = {
    "torque_constant": "joints",
    "armature": "joints",
    "viscous_friction": "joints",
    "coulomb_friction": "joints",
    "base_mass_offset": "trunk",
    "base_com_offset_x": "trunk",
    "base_com_offset_z": "trunk",
}
"""Parameters of the toolbox's model."""


class Peer:
    """One log in the form that the toolbox needs."""

    def __init__(self, log: Rollout):
        if log.metadata.mount != "floor" or np.ptp(log.array("command/p_gain")) > 0:
            raise ValueError("the toolbox's actuator has one gain for all times and joints, and the robot on the floor")
        self.log = log
        scene = build_scene("floor", "op3")
        self.spec = mujoco.MjSpec.from_string(scene.mjcf_model.to_xml_string(), assets=scene.mjcf_model.get_assets())
        self.spec.option.timestep = 0.001
        self.spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
        self.p_gain = float(log.array("command/p_gain")[0, 0])
        self.d_gain = float(log.array("command/d_gain")[0, 0])
        self.joints = scene.joint_names
        assert scene.robot is not None
        self.trunk = str(scene.robot.trunk.full_identifier)
        body = self.spec.body(self.trunk)
        self.mass, self.center = float(body.mass), np.array(body.ipos)
        for sensor in list(self.spec.sensors):
            self.spec.delete(sensor)
        for name in self.joints:
            self.spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        # the toolbox divides by the size of what each sensor measured: a joint whose readings are all zero has none
        kinds = {"position": mujoco.mjtSensor.mjSENS_JOINTPOS, "velocity": mujoco.mjtSensor.mjSENS_JOINTVEL}
        readings = []
        for log_name, name in zip(log.joints, self.joints, strict=True):
            for kind, sensor in kinds.items() if log_name in load_robot("op3").controlled else ():
                measured = log.array(f"joint/{kind}")[:, log.joints.index(log_name)]
                if measured.any():
                    what = {"name": f"{kind}_{log_name}", "type": sensor, "objname": name}
                    self.spec.add_sensor(objtype=mujoco.mjtObj.mjOBJ_JOINT, **what)
                    readings.append(measured)
        self.measured = np.stack(readings, 1)
        self.initial = scene.initial_qpos(log.array("joint/position")[0], *log.array("imu/orientation")[0, :2])

    def apply(self, spec: mujoco.MjSpec, name: str, value: float) -> None:
        """Write one parameter into a spec."""
        if name == "torque_constant":
            for joint in self.joints:
                actuator = spec.actuator(joint)
                gain = load_robot("op3").servos[0].motor.gear_ratio.si * value * self.p_gain
                actuator.gainprm[0] = gain
                actuator.biastype = mujoco.mjtBias.mjBIAS_AFFINE
                actuator.biasprm[:3] = [
                    0.0,
                    -gain,
                    -load_robot("op3").servos[0].motor.gear_ratio.si * value * self.d_gain,
                ]
        elif PEER[name] == "joints":
            field = {"armature": "armature", "viscous_friction": "damping", "coulomb_friction": "frictionloss"}[name]
            for joint in self.joints:
                element = spec.joint(joint)
                if field == "damping":
                    element.damping = (
                        np.full_like(np.asarray(element.damping), 0.0) if np.ndim(element.damping) else 0.0
                    )
                    if np.ndim(element.damping):
                        element.damping[0] = value
                    else:
                        element.damping = value
                else:
                    setattr(element, field, value)
        elif name == "base_mass_offset":
            spec.body(self.trunk).mass = self.mass + value
        else:
            axis = "xyz".index(name[-1])
            center = np.array(spec.body(self.trunk).ipos)
            center[axis] = self.center[axis] + value
            spec.body(self.trunk).ipos = center

    def sequences(self, start: dict[str, float]) -> Any:
        """The log as the toolbox's input."""
        for name, value in start.items():
            self.apply(self.spec, name, value)
        model = self.spec.compile()
        data = mujoco.MjData(model)
        data.qpos[:] = self.initial
        state = sysid.create_initial_state(model, data.qpos, data.qvel, data.act)
        time_ = self.log.array("time")[:, 0] - self.log.array("time")[0, 0]
        control = sysid.TimeSeries(time_, self.log.array("command/position"))
        measured = sysid.TimeSeries.from_names(time_, self.measured, model)
        name = self.log.metadata.recording or "squat"
        return sysid.ModelSequences("op3", self.spec, name, state, control, measured)


def fit_peer(cfg: DictConfig, log: Rollout, heldout: Rollout) -> dict[str, Any]:
    """Identify with the toolbox; return errors, wall time and number of rollouts."""
    known = load_model(cfg.model).parameters()
    start = {name: known[name].nominal for name in PEER}
    peer = Peer(log)
    parameters = sysid.ParameterDict()
    for name in PEER:
        parameters.add(
            sysid.Parameter(
                name, nominal=start[name], min_value=known[name].low, max_value=known[name].high,
                modifier=lambda spec, p, name=name: peer.apply(spec, name, float(p.value[0])),
            )
        )  # fmt: skip
    residual = sysid.build_residual_fn(models_sequences=[peer.sequences(start)])
    count = 0

    def counted(x: np.ndarray, *rest: Any, **kwargs: Any) -> Any:
        nonlocal count
        count += 1 if x.ndim == 1 else x.shape[1]
        return residual(x, *rest, **kwargs)

    began = time.monotonic()
    found, _ = sysid.optimize(
        parameters, counted, optimizer="mujoco", verbose=False, max_iters=cfg.iterations,
        eps=cfg.difference_step, x_scale=np.array([known[n].high - known[n].low for n in PEER]),
    )  # fmt: skip
    seconds = time.monotonic() - began
    values = {name: float(found[name].value[0]) for name in PEER}
    unseen = Peer(heldout)
    return {
        "wall_seconds": seconds,
        "simulations": count,
        "simulated_seconds": count * log.duration,
        "error_mrad.train": error_mrad(peer, values),
        "error_mrad.heldout": error_mrad(unseen, values),
        "values": values,
    }


def error_mrad(peer: Peer, values: dict[str, float]) -> float:
    """Mean absolute error of the ten leg joints, open loop [mrad]."""
    for name, value in values.items():
        peer.apply(peer.spec, name, value)
    model = peer.spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = peer.initial
    joints = dict(zip(peer.log.joints, peer.joints, strict=True))
    places = [int(model.joint(joints[name]).qposadr[0]) for name in load_robot("op3").controlled]
    columns = [peer.log.joints.index(name) for name in load_robot("op3").controlled]
    errors = []
    measured, command = peer.log.array("joint/position")[:, columns], peer.log.array("command/position")
    steps = round(1.0 / (peer.log.metadata.rate * model.opt.timestep))
    for row in range(len(command)):
        errors.append(np.abs(data.qpos[places] - measured[row]))
        data.ctrl[:] = command[row]
        mujoco.mj_step(model, data, steps)
    return float(1e3 * np.mean(errors))


def fit_ours(cfg: DictConfig, log: Rollout, heldout: Rollout) -> dict[str, Any]:
    """Identify from the same logs with `method=lsq`, from angles and velocities only."""
    base = load_model(cfg.model)
    known = {name: base.parameters()[name] for name in cfg.parameters}
    weights = {("joint", "position"): 1.0, ("joint", "velocity"): 1.0}
    loss = TrajectoryLoss(load_robot("op3").controlled, weights)
    problem = Identification(base, [log], [heldout], list(known), joints=load_robot("op3").controlled, loss=loss)
    space = parse_search_space({PREFIX + name: f"interval({p.low}, {p.high})" for name, p in known.items()})
    nominal = {PREFIX + name: p.nominal for name, p in known.items()}
    began = time.monotonic()
    how = StudySettings(space, "random", n_trials=cfg.trials, population=cfg.trials, nominal=nominal, seed=cfg.seed)
    study = run_study(problem.evaluate, how, progress=False)
    fit = problem.finish(study, **plain(cfg.refine))
    assert fit.heldout is not None
    return {
        "wall_seconds": time.monotonic() - began,
        "simulations": round(fit.simulated_seconds / problem.problem.replay.seconds),
        "simulated_seconds": fit.simulated_seconds,
        "error_mrad.train": fit.fit.error_mrad,
        "error_mrad.heldout": fit.heldout.error_mrad,
        "values": {name: fit.model.value(name) for name in known},
    }


@hydra.main(config_path="../../conf/benchmark", config_name="sysid_peer", version_base="1.3")
def main(cfg: DictConfig) -> None:
    """Fit with both methods, and write page and result."""
    with one_sentence():
        torch.set_num_threads(1)
        if not hasattr(sysid, "optimize"):
            raise ValueError('mujoco.sysid is not completely installed: run pip install "mujoco[sysid]"')
        log, heldout = read_logs(cfg.data)[0], read_logs(cfg.heldout)[0]
        results = {"mujoco.sysid": fit_peer(cfg, log, heldout), "method=lsq": fit_ours(cfg, log, heldout)}
        folder = Path(HydraConfig.get().runtime.output_dir)
        provenance = run_provenance(seed=cfg.seed, data=[cfg.data, cfg.heldout])
        names = {"mujoco.sysid": "peer", "method=lsq": "ours"}
        numbers = {names[key]: value for key, value in results.items()}
        result = write_result(folder / "result.yaml", {**numbers, "provenance": provenance})
        held = {name: values["error_mrad.heldout"] for name, values in results.items()}
        lead = ", ".join(f"the error of {name} is {error:.1f} mrad" for name, error in held.items())
        columns = ["error_mrad.train", "error_mrad.heldout", "wall_seconds", "simulations"]
        rows = [[name, *(values[c] for c in columns)] for name, values in results.items()]
        header = ["", "error [mrad]", "held-out error [mrad]", "time [s]", "simulations"]
        prose = f"# Comparison with mujoco.sysid\nOn the held-out log {lead}.\n\n[[table errors]]"
        page = Page(prose, tables={"errors": (header, rows)})
        page.provenance(provenance)
        print(page.write(folder / "index.html"), result, sep="\n", flush=True)


if __name__ == "__main__":
    main()
