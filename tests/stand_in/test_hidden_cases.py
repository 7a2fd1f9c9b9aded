"""Cases: drawn from seeds, sealed before they are opened, told by nothing that the diagnosis sees."""

import dataclasses
import hashlib

import numpy as np
import pytest
import yaml

from op3.motions import robot_suite
from op3.rollout import Rollout, read_logs
from op3.stand_in import (
    CATALOGUE,
    KINDS,
    OUTSIDERS,
    SEVERITIES,
    Hidden,
    HiddenWorld,
    draw_case,
    make_case,
    open_answers,
    record_case,
    seal,
)
from op3.stand_in.cases import ALIAS_PAIRS, BASES, Case, answer_bytes, write_answer
from op3.stand_in.suites import SETTINGS, Setting
from tests.op3_table import JOINTS

QUIET = HiddenWorld(
    joint_spread=0.0, friction_drift=0.0, torque_noise=0.0, current_offset=0.0, current_noise=0.0, latency_jitter=0.0,
    placement=0.0,
)  # fmt: skip
"""A robot without noise, so that a difference is the effect's."""


def with_suite(monkeypatch, robot: str, runs) -> None:
    """Let a setting's suites be these runs."""
    setting = SETTINGS[robot]
    suite = lambda seed: runs  # noqa: E731
    monkeypatch.setitem(SETTINGS, robot, Setting(setting.scene, suite, suite, 0.4, setting.metadata))


def record(*hidden: Hidden, world: HiddenWorld = QUIET, robot: str = "op3") -> list[Rollout]:
    case = dataclasses.replace(draw_case(3, "null", robot=robot), world=world, hidden=hidden)
    return list(record_case(case))


def test_a_case_is_what_its_seed_says():
    """Equal seeds and wishes give equal answers, byte by byte; another seed another case."""
    first, same, other = (answer_bytes(draw_case(seed, "pair", "strong", robot="op3")) for seed in (4, 4, 5))
    assert first == same
    assert first != other


@pytest.fixture(scope="module")
def drawn() -> dict[str, list[Case]]:
    """Twenty-five cases of every kind."""
    return {
        kind: [draw_case(seed, kind, "strong", robot="op3") for seed in range(25)]
        for kind in ("single", "pair", "null", "outsider")
    }


def test_kinds_hide_what_they_say(drawn):
    """One, two, none, an outsider; a base model lacks exactly the effect of `BASES` that is hidden, if any is."""
    for kind, count in (("single", 1), ("pair", 2), ("null", 0), ("outsider", 1)):
        for case in drawn[kind]:
            names = {hidden.name for hidden in case.hidden}
            assert len(names) == count
            assert names <= set(OUTSIDERS if kind == "outsider" else CATALOGUE)
            lacking = [name for name in names if name in BASES]
            assert not lacking or [case.base] == [BASES[name] for name in lacking]
    alike = sum(any(set(pair) == {one.name for one in case.hidden} for pair in ALIAS_PAIRS) for case in drawn["pair"])
    assert 6 <= alike <= 22


def test_the_base_model_does_not_give_the_answer_away(drawn):
    """Cases that hide nothing start from models with and without dte, stribeck and latency, as the robot has them."""
    assert len({case.base for case in drawn["null"]}) >= 3
    for case in drawn["null"]:
        assert (case.world.backward_efficiency == 1.0) == (case.base == "paper_without_dte")
        assert (case.world.static_friction_excess == 0.0) == (case.base == "paper_without_stribeck")
        assert (case.world.command_latency == 0.0) == (case.base == "paper_without_latency")


def test_effects_sit_where_they_can(drawn):
    """Single joints on both sides and mirror pairs; a loaded joint is never the head, a far one never at the base."""
    hidden = [one for kind in ("single", "pair", "outsider") for case in drawn[kind] for one in case.hidden]
    local = [one for one in hidden if one.joints]
    assert {len(one.joints) for one in local} == {1, 2}
    assert {one.joints[0][:2] for one in local} >= {"l_", "r_"}
    for one in local:
        place = KINDS[one.name].place
        assert not (place == "loaded" and one.joints[0].startswith("head"))
        assert not (place == "far" and one.joints[0].endswith(("hip_yaw", "hip_roll", "sho_pitch", "pan", "tilt")))
        assert len(one.joints) == 1 or one.joints[0][1:] == one.joints[1][1:]


def test_sizes_follow_the_severity():
    """dte of 0.1 is the smallest that matters: mild is 0.9 to 1.1 times that, strong five times as much."""
    cases = {severity: draw_case(7, "single", severity, "dte", robot="op3") for severity in SEVERITIES}
    sizes = {severity: case.hidden[0].size for severity, case in cases.items()}
    assert 0.09 <= sizes["mild"] <= 0.11
    assert sizes["clear"] == pytest.approx(2.5 * sizes["mild"])
    assert sizes["strong"] == pytest.approx(5 * sizes["mild"])
    assert cases["strong"].world.backward_efficiency == pytest.approx(1 / (1 + sizes["strong"]))


def test_sealed_answers_open_only_unchanged(tmp_path):
    """The file lists the SHA-256 of each answer; a changed, added or missing answer is refused by name."""
    paths = [write_answer(draw_case(seed, robot="op3"), tmp_path) for seed in (1, 2)]
    commitment = seal(tmp_path).read_text()
    assert hashlib.sha256(paths[0].read_bytes()).hexdigest() + "  " + paths[0].name in commitment
    assert set(open_answers(tmp_path)) == {path.stem for path in paths}
    content = paths[0].read_bytes()
    paths[0].write_bytes(content.replace(b"seed: 1", b"seed: 9"))
    with pytest.raises(ValueError, match=f"{paths[0].name} was changed"):
        open_answers(tmp_path)
    paths[0].unlink()
    with pytest.raises(ValueError, match="sealed but missing"):
        open_answers(tmp_path)
    paths[0].write_bytes(content)
    write_answer(draw_case(3, robot="op3"), tmp_path)
    with pytest.raises(ValueError, match="never sealed"):
        open_answers(tmp_path)


def test_the_logs_tell_nothing_but_what_sensors_say(tmp_path, monkeypatch):
    """A case's folder holds logs that read back and the base model; no seed, size or name of what is hidden."""
    with_suite(monkeypatch, "op3", [robot_suite(1, duration=0.25)[i] for i in (2, 8, 22)])
    case = draw_case(1, "single", "strong", "backlash", robot="op3")
    place = make_case(case, tmp_path / "cases", tmp_path / "answers")
    logs = read_logs(place / "data")
    assert [log.metadata.extra["tilt"] for log in logs] == [[0.0, 0.0], [0.5, 0.8], [0.0, 0.0]]
    assert logs[0].joints == JOINTS
    assert logs[0].metadata.seed is None
    for log in logs:
        log.check()
    assert logs[2].array("joint/temperature").mean() > logs[0].array("joint/temperature").mean() + 20
    given = yaml.safe_load((place / "case.yaml").read_text())
    assert given == {"case": case.name, "robot": "op3", "base": case.base}
    texts = "".join(path.read_text() for path in place.rglob("*.yaml"))
    assert "backlash" not in texts
    assert answer_bytes(case) == (tmp_path / "answers" / f"{case.name}.yaml").read_bytes()
    again = list(record_case(case))
    for one, other in zip(again, logs, strict=True):
        assert np.array_equal(one.array("joint/current"), other.array("joint/current"))


def test_every_setting_is_recorded():
    """A pendulum, a leg, the robot in the stand and on its feet: two runs of each, of its joints, and nobody falls."""
    for robot, setting in SETTINGS.items():
        case = draw_case(11, "single", "clear", "coulomb", robot=robot)
        logs = [log for log, _ in zip(record_case(case), range(2), strict=False)]
        assert logs[0].joints == case.joints == tuple(joint.name for joint in setting.scene().joints)
        assert not any(log.metadata.fallen for log in logs)
        assert len(setting.rich(1)) == len(setting.poor(1)) == 26
        repeated = [run.motion for run in setting.rich(1) if run.motion.name.startswith("repeated")]
        assert len(repeated) == 8
        assert len({run.position.tobytes() for run in repeated}) == 2


@pytest.fixture
def short(monkeypatch):
    """Of the leg: steps, holds, and a warm multisine, most of a second each."""
    from op3.motions import leg_suite

    with_suite(monkeypatch, "leg", [leg_suite(3, duration=0.8)[i] for i in (7, 10, 22)])


def channels(logs: list[Rollout]) -> np.ndarray:
    names = ("joint/position", "joint/velocity", "joint/current")
    return np.stack([np.concatenate([log.array(name) / log.array(name).std() for name in names], 1) for log in logs])


def test_effects_of_size_zero_are_none(short):
    """Everything that can be hidden, one by one at size zero, changes no bit of any log."""
    bare = channels(record(robot="leg"))
    hidden = [Hidden(name, 0.0, () if KINDS[name].place == "all" else ("r_knee",)) for name in KINDS]
    assert (channels(record(*hidden, robot="leg")) == bare).all()


def test_every_strong_effect_shows(short):
    """Five times the smallest size that matters moves some channel of the leg by 1 % and more."""
    bare = channels(record(robot="leg"))
    for name, kind in KINDS.items():
        if name in BASES:
            continue
        for form in kind.forms:
            hidden = Hidden(name, 5 * kind.size, () if kind.place == "all" else ("r_knee",), form, (0.3, 0.3, 0.3))
            moved = channels(record(hidden, robot="leg"))
            assert np.sqrt(((moved - bare) ** 2).mean((0, 1))).max() > 0.01, (name, form)


def test_an_effect_shows_where_it_sits(monkeypatch):
    """An encoder offset in the left knee shows in the left knee's current, where the robot holds still."""
    with_suite(monkeypatch, "op3", robot_suite(3, duration=0.4)[:1])
    plain, moved = (record(*hidden)[0] for hidden in ((), (Hidden("encoder_offset", 0.05, ("l_knee",)),)))
    apart = np.abs(moved.array("joint/current") - plain.array("joint/current")).max(0)
    assert apart[JOINTS.index("l_knee")] > 5 * apart[JOINTS.index("r_knee")]


def test_an_effect_where_there_is_no_joint():
    """It is refused with the joints there are, as is a name that the table does not hold."""
    with pytest.raises(ValueError, match="cannot sit in 'tail'; the joints are head_pan"):
        list(record(Hidden("coulomb", 0.1, ("tail",))))
    with pytest.raises(ValueError, match="'rust' cannot be hidden"):
        Hidden("rust", 1.0)
    with pytest.raises(ValueError, match="there is no robot 'dog' of a case; choose op3"):
        draw_case(1, robot="dog")
