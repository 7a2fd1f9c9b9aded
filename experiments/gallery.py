"""Draw the pictures of the gallery, docs/gallery.md, and the README's.

python experiments/gallery.py <picture> ... [--out docs/images]
"""

import argparse
import io
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from PIL import Image

from op3.apps.sim2real import JUDGED
from op3.common.plain_names import words
from op3.diagnose import Diagnosis, diagnosed_mount, split_logs, suited
from op3.envs import BatchedEnv, record_episodes
from op3.motions import Motion, chirp, multisine, squat, staircase, triangle
from op3.policy import PolicyBundle
from op3.report.frames import draw_frames
from op3.report.result import read_result
from op3.report.style import INK, MUTED, PALETTE
from op3.report.video import states_of_log
from op3.robot import pose
from op3.rollout import read_logs
from op3.scenes import build_scene
from op3.servo import RobotModel, Servos, catalogue, law
from op3.sim import load_model, model_for
from op3.stand_in import HiddenWorld, StandIn, draw_case, make_case
from op3.tasks.behaviour import gait_profile
from op3.tasks.evaluation import evaluation_return
from op3.tasks.task import find_task

IMAGES = Path(__file__).resolve().parents[1] / "docs" / "images"
PICTURES: dict[str, Callable[[], Image.Image]] = {}
"""Drawing function of each picture, by name."""


plt.switch_backend("Agg")
plt.rcParams |= {
    "axes.prop_cycle": matplotlib.cycler(color=PALETTE), "axes.spines.top": False, "axes.spines.right": False,
    "axes.edgecolor": MUTED, "axes.labelcolor": INK, "figure.dpi": 120, "figure.constrained_layout.use": True,
    "font.size": 9, "legend.frameon": False, "lines.linewidth": 1.4,
}  # fmt: skip


def panels(rows: int = 1, columns: int = 1, height: float = 3.0, **options):
    """A figure of this height in inches, and its axes."""
    return plt.subplots(rows, columns, figsize=(8.0, height), **options)


def drawn(figure: Figure) -> Image.Image:
    """A figure as a picture."""
    data = io.BytesIO()
    figure.savefig(data)
    plt.close(figure)
    return Image.open(data).convert("RGB")


def above(axis: Axes) -> None:
    """A legend in one row over an axis, where it hides nothing."""
    axis.legend(ncol=4, loc="lower center", bbox_to_anchor=(0.5, 0.98))


def strip(frames: np.ndarray, top: int = 40, height: int = 400) -> Image.Image:
    """Frames ``[frame, height, width, 3]`` side by side, without their empty margins, from a row on."""
    return Image.fromarray(np.concatenate([frame[top : top + height, 90:390] for frame in frames], axis=1))


def picture(draw: Callable[[], Image.Image]) -> Callable[[], Image.Image]:
    """Register a function under its name."""
    PICTURES[draw.__name__] = draw
    return draw


@picture
def poses() -> Image.Image:
    """The OP3 in three poses."""
    scene = build_scene("floor", "op3")
    return strip(
        draw_frames(
            scene.compile(),
            np.stack([scene.initial_qpos(pose(n, "op3")) for n in ("stand", "squat_high", "squat_low")]),
        )
    )


@picture
def balance() -> Image.Image:
    """The shipped policy on the board that decides transfers, at four times."""
    bundle = PolicyBundle.load("assets/policies/balance")
    env = BatchedEnv(find_task("balance_eval"), load_model("paper"), 1, 501, action_map=bundle.manifest.action_map)
    scene = build_scene("board", "op3")
    states = states_of_log(record_episodes(env, bundle)[0], scene, 125.0)
    return strip(draw_frames(scene.compile(), states[[63, 325, 575, 825]]))


@picture
def walk() -> Image.Image:
    """The shipped policy on bricks of 5 mm, at five times within a cycle of its gait."""
    bundle, task = PolicyBundle.load("assets/policies/walk"), find_task("walk_bricks_c")
    env = BatchedEnv(task, load_model("paper"), 1, 901, action_map=bundle.manifest.action_map)
    scene = build_scene(task.scene, "op3")
    states = states_of_log(record_episodes(env, bundle)[0], scene, 125.0)
    return strip(draw_frames(scene.compile(), states[250:375:25], follow=True), height=440)


@picture
def ankle() -> Image.Image:
    """Commands of the shipped walk to an ankle over the gait: means and standard deviations of 20 episodes."""
    bundle, task = PolicyBundle.load("assets/policies/walk"), find_task("walk")
    env = BatchedEnv(task, load_model("paper"), 20, 901, action_map=bundle.manifest.action_map)
    profile = gait_profile(record_episodes(env, bundle), task, "r_ank_pitch")
    figure, axes = panels(1, 2)
    half = 0.5 / len(profile.phase)
    for axis, mean, deviation, label in (
        (axes[0], profile.target, profile.target_deviation, "target angle [rad]"),
        (axes[1], profile.gain, profile.gain_deviation, "P gain [A/rad]"),
    ):
        for phase in profile.phase[profile.stance]:
            axis.axvspan(phase - half, phase + half, color="0.92", lw=0)
        axis.plot(profile.phase, mean)
        axis.fill_between(profile.phase, mean - deviation, mean + deviation, alpha=0.2, lw=0)
        axis.set(xlabel="phase of the gait [cycles], support shaded", ylabel=label)
    return drawn(figure)


@picture
def named_effect() -> Image.Image:
    """A leg with an unmodelled gear loss: measured, and simulated before and after a diagnosis."""
    case = draw_case(7, "single", "strong", "dte", robot="leg")
    with tempfile.TemporaryDirectory() as folder:
        logs, _ = diagnosed_mount(read_logs(make_case(case, folder, Path(folder) / "answers") / "data"))
    model = suited(model_for(logs[0].robot, case.base), logs)
    verdict = Diagnosis(model, split_logs(logs, seed=0), seed=0).run()
    pairs = list(zip(verdict.shown["before"], verdict.shown["after"], strict=True))

    def angles(prediction, joint: str) -> tuple[np.ndarray, np.ndarray]:
        column = prediction.log.joints.index(joint)
        simulated = prediction.channels["joint", "position"][0, :, column].numpy()
        return np.degrees(simulated), np.degrees(prediction.log.array("joint/position")[: len(simulated), column])

    def won(pair, joint: str) -> float:
        before, after = (np.abs(np.subtract(*angles(prediction, joint))).mean() for prediction in pair)
        return before - after

    pair, joint = max(((p, j) for p in pairs for j in logs[0].joints), key=lambda place: won(*place))
    time = pair[0].log.array("time")[:, 0]
    figure, axes = panels(2, 1, 4.2, sharex=True, height_ratios=(2, 1))
    for prediction, label, colour in zip(
        pair, ("simulated before", "simulated after"), (PALETTE[1], PALETTE[0]), strict=True
    ):
        simulated, measured = angles(prediction, joint)
        axes[0].plot(time[: len(simulated)], simulated, color=colour, label=label)
        axes[1].plot(time[: len(simulated)], simulated - measured, color=colour)
    axes[0].plot(time[: len(measured)], measured, color=INK, linestyle=":", label="measured")
    print(verdict.sentence)
    axes[0].set(ylabel=f"{joint} [deg]")
    above(axes[0])
    axes[1].set(ylabel="error [deg]", xlabel="time [s]")
    return drawn(figure)


@picture
def gear() -> Image.Image:
    """Directional efficiency: the range of motor torques at which a loaded joint rests."""
    load = np.linspace(-3, 3, 241)
    figure, axes = panels(1, 3, 2.8, sharey=True)
    for axis, efficiency in zip(axes, (1.0, 0.8, 0.6), strict=True):
        motor, outside = np.meshgrid(load, load)
        loss = np.vectorize(law.dte_passive_loss)(motor, outside, 1.0, efficiency)
        axis.contourf(load, load, (np.abs(motor + outside) <= loss + 0.15).T, levels=[0.5, 1.5], colors=[PALETTE[4]])
        axis.set(title=f"backward efficiency {efficiency:g}", xlabel="torque of the load [N m]")
    axes[0].set_ylabel("torque of the motor [N m]")
    return drawn(figure)


def friction_bound(model: RobotModel, velocity: np.ndarray, load: float) -> np.ndarray:
    """Bound of friction of a servo that carries a load at some speeds [N m]."""
    servos = Servos(model.effects, ["servo"], len(velocity), 0.001, 0.008)
    servos.set(model.tensors(["servo"]))
    servos.signals.velocity, servos.signals.load_torque = velocity[:, None], load
    servos.reset()
    servos.tick()
    servos.step()
    return servos.signals.friction_bound[:, 0].numpy().copy()


@picture
def friction() -> Image.Image:
    """Friction in the models of the STS3032, with and without load."""
    velocity = np.linspace(0.0, 6.0, 121)
    figure, axes = panels(1, 2, 2.8, sharey=True)
    for axis, load in zip(axes, (0.0, 0.5), strict=True):
        for name in ("rhoban_m1", "rhoban_m4", "rhoban_m6", "sts3032"):
            axis.plot(velocity, friction_bound(load_model(name), velocity, load), label=name)
        axis.set(title=f"load {load:g} N m", xlabel="speed [rad/s]")
    axes[0].set(ylabel="friction [N m]", ylim=(0, None))
    axes[0].legend()
    return drawn(figure)


@picture
def worlds() -> Image.Image:
    """The same squat of four hidden robots."""
    figure, axes = panels(2, 1, 4.0, sharex=True)
    for name in ("default", "eta_060", "eta_080", "robot_5"):
        log = StandIn(HiddenWorld.find(name), build_scene("floor", "op3"), seed=0).play(
            squat(duration=4.0), p_gain=6.0, d_gain=0.1
        )
        time = log.array("time")[:, 0]
        error = np.degrees(log.column("l_knee.position") - log.column("l_knee.target"))
        axes[0].plot(time, error, label=name)
        axes[1].plot(time, log.column("l_knee.current"))
    axes[0].set(ylabel="left knee off its target [deg]")
    above(axes[0])
    axes[1].set(ylabel="its current [A]", xlabel="time [s]")
    return drawn(figure)


@picture
def excitations() -> Image.Image:
    """Motions that make parameters identifiable."""
    knee = {"l_knee": 0.4}
    motions: dict[str, Motion] = {
        "chirp": chirp(knee, low=0.3, high=4.0, duration=8.0, robot="op3"),
        "triangle": triangle(knee, speed=0.4, robot="op3"),
        "multisine": multisine(knee, duration=8.0, robot="op3"),
        "staircase": staircase(knee, robot="op3"),
    }
    figure, axes = panels(len(motions), 1, 5.0)
    for axis, (name, motion) in zip(axes, motions.items(), strict=True):
        column = np.argmax(np.ptp(motion.position, axis=0))
        axis.plot(motion.time, np.degrees(motion.position[:, column]), color=PALETTE[0])
        axis.set(ylabel=f"{name}\n[deg]", xlim=(0, 8))
    axes[-1].set_xlabel("time [s]")
    return drawn(figure)


@picture
def voltage() -> Image.Image:
    """Torque of an XM430-W350 over speed, limited by the supply voltage minus the back-EMF."""
    speed = np.linspace(0, 6, 121)
    model = load_model("paper")
    constant = 353.5 * model.value("torque_constant")
    figure, axis = panels(height=2.8)
    for supply in (10.0, 11.1, 12.6):
        current = np.clip((supply - constant * speed) / model.value("terminal_resistance"), -2.3, 2.3)
        axis.plot(speed, constant * current, label=f"{supply:g} V")
    axis.set(xlabel="speed [rad/s]", ylabel="torque before friction [N m]", ylim=(0, None))
    axis.legend()
    return drawn(figure)


@picture
def bus() -> Image.Image:
    """Two ticks on the robot's bus: which device sends when."""
    from op3.deploy import HoldPose, Plan, connect, run
    from op3.deploy.emulator import read_frames

    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "frames.txt"
        robot = connect("emulated", mount="stand", record=file, robot="op3")
        run(robot, lambda: HoldPose(pose("stand", "op3"), duration=0.5, log="run"), Plan(folder=Path(folder) / "run"))
        frames = read_frames(file)
    middle = frames[len(frames) // 2].time
    figure, axis = panels(height=2.2)
    for frame in frames:
        begin = 1e3 * (frame.time - middle)
        if 0 <= begin < 16:
            axis.barh(
                frame.direction == "<",
                1e3 * len(frame.data) * 10 / 2e6,
                left=begin,
                color=PALETTE[frame.direction == "<"],
            )
    axis.set(yticks=[0, 1], yticklabels=["computer", "servos, OpenCR"], xlabel="time [ms]", xlim=(0, 16))
    return drawn(figure)


@picture
def bricks() -> Image.Image:
    """The grounds on which the walk is judged, with the robot among the bricks."""
    frames = []
    for name in ("bricks_a", "bricks_b", "bricks_c", "bricks_d"):
        scene = build_scene(name, "op3")
        state = scene.initial_qpos(pose("stand", "op3"))
        state[0], state[2] = state[0] + 0.8, state[2] + 0.005
        frames.append(draw_frames(scene.compile(), state[None])[0])
    return strip(np.stack(frames), top=80)


def transfers(table: Path) -> Image.Image:
    """Excitation only: learning curves, identified parameters, and returns of every robot of a table of transfers."""
    figure, (curves, parameters, returns) = panels(1, 3, 3.2, width_ratios=(1, 1, 1.2))
    cells = sorted(table.glob("*_excitation_only_*/result.yaml"), key=lambda path: (len(str(path)), path))
    if not cells:
        raise SystemExit(f"{table} has no finished cells of a table of transfers; run op3 transfers, or give --table")
    names = {name.removeprefix("parameters.") for name in read_result(cells[0].parent / "identify" / "result.yaml")}
    searched = [
        parameter for effect in catalogue().values() for parameter in effect.parameters if parameter.name in names
    ]
    for number, cell in enumerate(cells):
        folder, result = cell.parent, read_result(cell)
        training, identified = (read_result(folder / stage / "result.yaml") for stage in ("0_train", "identify"))
        curves.plot(training["learning.steps"], training["learning.return"], color=MUTED, lw=0.8)
        hidden = HiddenWorld.find(result["world"], 0)
        for colour, parameter in enumerate(searched):
            name, low, high = parameter.name, parameter.low, parameter.high
            values = getattr(hidden, name), identified[f"parameters.{name}"]["value"]
            shares = [(value - low) / (high - low) for value in values]
            label = words(name) if number == 0 else None
            parameters.plot(*shares, ".", color=plt.get_cmap("tab10")(colour), label=label)
        promised = read_result(folder / "0_expected" / "result.yaml")["evaluation.returns"]
        obtained = [evaluation_return(log, JUDGED[result["task"]]) for log in read_logs(folder / "0_robot")]
        for values, side, colour, label in ((promised, -0.15, 1, "expected"), (obtained, 0.15, 0, "on the robot")):
            label = label if number == 0 else None
            returns.plot([number + 1 + side] * len(values), values, ".", ms=3, color=PALETTE[colour], label=label)
    curves.set(xlabel="environment steps", ylabel="mean return of the evaluations")
    parameters.plot([0, 1], [0, 1], color=MUTED, lw=0.8)
    parameters.set(xlabel="hidden value, 0 to 1 in Table I", ylabel="identified value")
    parameters.legend(fontsize=6, loc="upper left", bbox_to_anchor=(0.98, 1.02), handletextpad=0)
    returns.set(xlabel="robot", ylabel="return R_eval", xticks=range(1, len(cells) + 1))
    above(returns)
    return drawn(figure)


def main() -> None:
    """Draw the requested pictures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("pictures", nargs="+", choices=sorted([*PICTURES, "transfers"]), help="pictures to draw")
    parser.add_argument("--out", type=Path, default=IMAGES, help="folder of the pictures")
    parser.add_argument("--table", type=Path, default="outputs/transfer_table", help="folder of the table of transfers")
    options = parser.parse_args()
    PICTURES["transfers"] = partial(transfers, options.table)
    options.out.mkdir(parents=True, exist_ok=True)
    for name in options.pictures:
        path = options.out / f"{name}.webp"
        PICTURES[name]().save(path, quality=82, method=6)
        print(f"{path}, {-(-path.stat().st_size // 1000)} kB")


if __name__ == "__main__":
    main()
