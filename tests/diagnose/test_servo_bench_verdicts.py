"""Real recordings of servos that swing a pendulum, which lie beside the repository, not in it."""

from pathlib import Path

import numpy as np
import pytest

from op3.diagnose import Diagnosis, Verdict, diagnose_swings, split_logs, suited
from op3.diagnose.setups import SetupHypothesis, setup_hypotheses
from op3.diagnose.split import LogSplit
from op3.diagnose.swing import FEWEST, split_swings, swings
from op3.rollout import LogError, Metadata, Rollout, read_logs
from op3.sim import load_model

BENCH = Path(__file__).resolve().parents[2] / ".." / "shared" / "data" / "servo_bench"
LOAD = {"dte", "load_friction", "directional_friction", "antagonistic_friction"}
"""Effects in which friction depends on the load: Rhoban's ladder from M3 on, and the directional efficiency."""

here = pytest.mark.skipif(not BENCH.is_dir(), reason=f"no recordings in {BENCH}")


def pendulum(length: float = 0.1, released: bool = True, servo: str = "xl330") -> Rollout:
    """Two seconds of holding at 1 rad, then two of a swing of 3 rad/s about 0.1 rad."""
    time = np.arange(800) / 200
    on = time < 2.0 if released else time >= 0.0
    angle = np.where(on, 1.0, 0.1 + 0.9 * np.cos(3 * (time - 2.0)))
    arrays = {"time": time, "joint/position": angle, "command/position": np.ones_like(time)}
    arrays |= {"command/torque_enable": on.astype(float), "command/firmware_gain": np.full_like(time, 100.0)}
    metadata = Metadata(
        joints=("servo",), robot="rig", mount="pendulum", rate=200.0, mass=0.5, length=length, servo=servo
    )
    return Rollout.from_arrays(
        {key: value if key == "time" else value[:, None] for key, value in arrays.items()}, metadata
    )


def test_a_swing_begins_where_the_pendulum_is_let_go():
    """It starts within a row of t = 2 s, at rest at 1 rad, and holds nothing that was driven."""
    (part,) = swings([pendulum(), pendulum(released=False)])
    assert part.array("joint/position")[0, 0] == pytest.approx(1.0, abs=0.01)
    assert not part.array("command/torque_enable").any()
    assert part.array("time")[0, 0] == pytest.approx(2.0, abs=0.1)


def test_no_swing_serves_two_purposes():
    """Ten swings: two show, two choose, six are fitted."""
    parts = swings([pendulum(length=0.05 + 0.01 * i) for i in range(10)])
    split = split_swings(parts)
    assert (len(split.fit), len(split.select), len(split.show)) == (6, 2, 2)
    assert len({log.metadata.length for log in split.logs}) == 10


def test_too_few_swings_say_nothing():
    """Three releases are not enough to fit, choose and show."""
    logs = [pendulum() for _ in range(FEWEST - 1)]
    assert diagnose_swings(load_model("xl330_m1"), logs) is None


def test_set_ups_are_told_apart_by_their_metadata():
    """Two lengths and one mass: the zero of the arm may differ by length, and by nothing else."""
    model = load_model("xl330_m1")
    (hypothesis,) = setup_hypotheses(model, [pendulum(0.05), pendulum(0.1)])
    assert hypothesis.label(("servo",)) == "encoder_offset by length"
    assert hypothesis.names == ("encoder_offset@length=5e-2", "encoder_offset@length=1e-1")
    assert setup_hypotheses(model, [pendulum(0.1), pendulum(0.1)]) == []


def test_set_ups_are_refitted_each_from_where_it_stands():
    """Arms of two lengths that swing at one rate, as no two pendulums do: their zeros come apart, and explain some."""
    logs = [pendulum(length) for length in [0.05, 0.1] * 3]
    split = LogSplit(tuple(logs[:2]), tuple(logs[2:4]), tuple(logs[4:]))
    diagnosis = Diagnosis(load_model("xl330_m1"), split, seed=0)
    base = diagnosis.refit_base(diagnosis.given)
    every = [s for s in diagnosis.screen(base) if isinstance(s.hypothesis, SetupHypothesis)]
    refitted = min(diagnosis.refit_of(base, every), key=lambda one: one.fit.loss)
    short, long = refitted.fit.point[len(base.coordinates) :]
    assert refitted.contender.fit_gain > 0.05
    assert abs(short - long) > 0.1


def test_a_model_driven_by_current_becomes_one_of_the_servo():
    """Friction is kept, motor and controller are the servo's; a model of the servo stays as it is."""
    model = suited(load_model("coulomb_viscous"), [pendulum()])
    assert set(model.effect_names) == {"position_servo", "motor", "coulomb", "viscous", "encoder_offset"}
    lossy = suited(load_model("paper"), [pendulum()])
    assert {"dte", "stribeck"} <= set(lossy.effect_names)
    assert lossy.value("static_friction_excess") < 0.1 * load_model("paper").value("static_friction_excess")
    own = load_model("xl330")
    assert suited(own, [pendulum()]) is own


def test_a_servo_without_a_model_is_refused():
    """What is missing, and where it can be seen how it is written."""
    with pytest.raises(LogError, match=r"servo 'ax12'.*conf/servo/xl330_m1.yaml"):
        suited(load_model("paper"), [pendulum(servo="ax12")])


def diagnosed(folder: str) -> Verdict:
    """The verdict on all recordings of a servo, from Coulomb and viscous friction."""
    logs = read_logs(BENCH / folder)
    return Diagnosis(suited(load_model("coulomb_viscous"), logs), split_logs(logs)).run()


@here
@pytest.mark.slow
def test_the_xl330_lacks_friction_under_load_and_no_delay():
    """Load-dependent friction is named and shrinks the gap on unseen runs; controller gain and delay, which its duty
    contradicts, explain nothing."""
    verdict = diagnosed("xl330")
    assert verdict.verdict in ("named", "ambiguous")
    assert {effect.name for effect in verdict.effects} <= LOAD
    gap = verdict.gap["joint/position"]
    assert gap["after"] < 0.75 * gap["before"]
    gains = {entry["name"]: entry["gain"] for entry in verdict.details["ranking"]}
    assert max(gains["position_servo"], gains["latency"]) < 0.1


@here
@pytest.mark.slow
def test_the_sts3032_lacks_friction_under_load():
    """The first name is load-dependent friction, and the loss on unseen runs shrinks."""
    verdict = diagnosed("sts3032")
    assert verdict.verdict in ("named", "ambiguous")
    assert {effect.name for effect in verdict.effects} <= LOAD
    assert verdict.loss["after"] < verdict.loss["before"]


@here
@pytest.mark.slow
def test_free_swings_of_the_sts3032_show_that_the_arm_was_mounted_anew():
    """With torque off, each length has a zero of its own, which explains half of what is left, and shrinks the gap."""
    logs = read_logs(BENCH / "sts3032")
    swing = diagnose_swings(suited(load_model("coulomb_viscous"), logs), logs, rounds=1)
    assert swing is not None
    zero = swing.effects[0]
    assert (zero.name, zero.by) == ("encoder_offset", "length")
    assert zero.gain > 0.4
    # where pendulums of 0.05 m come to rest, read off the recordings: 0.104 to 0.109 rad for the heavy one
    assert zero.parameters["encoder_offset@length=5e-2"] == pytest.approx(0.105, abs=0.02)
    assert swing.gap["joint/position"]["after"] < swing.gap["joint/position"]["before"]
