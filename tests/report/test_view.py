"""Looking at a run: robots in one scene, plots beside them, a film, and what the keys of the window do."""

import os
from dataclasses import replace
from importlib import import_module

import numpy as np
import pytest
from omegaconf import OmegaConf
from report_logs import squat_log

from op3.motions import squat
from op3.policy.card import Card
from op3.replay import simulate_motion
from op3.report.frames import RenderError, draw_frames
from op3.report.tracks import Tracks, scene_of
from op3.report.video import write_film
from op3.report.viewer import RATE, Playback, Strip, lines_of
from op3.robot import load_robot
from op3.rollout import Metadata, Rollout
from op3.sim import load_model
from tests.envs.holding import holding_bundle


def arm_tracks(rows: int = 126, late: float = 0.3) -> Tracks:
    """The six-joint arm swings its third joint by a radian in a second; its overlay ends early, and is late by that."""
    arm = load_robot("arm")
    time = 0.008 * np.arange(rows)
    position = np.tile(arm.home, (rows, 1))
    position[:, 2] += np.sin(np.pi / 2 * time)
    metadata = Metadata(arm.joints, "simulated", "stand", 125.0, robot_file="arm")
    arrays = {"time": time, "joint/position": position, "command/position": position}
    overlay = position.copy()
    overlay[:, 2] -= late
    half = {key: value[: rows // 2] for key, value in {**arrays, "joint/position": overlay}.items()}
    logs = {
        "measured": Rollout.from_arrays(arrays, metadata),
        "simulated": Rollout.from_arrays(half, replace(metadata, robot="simulated")),
    }
    return Tracks(logs, scene_of(logs["measured"]))


def test_a_overlay_that_ends_early_stays_where_it_ended():
    """One second at 25 frames is 26 frames; the overlay's half a second, 62 rows, has its last at 12/25 s, row 60."""
    tracks = arm_tracks()
    states = tracks.states(25.0)
    assert states.shape == (2, 26, 6)
    overlay = tracks.logs["simulated"].array("joint/position")
    np.testing.assert_array_equal(states[1, 12:], np.tile(overlay[60], (14, 1)))


def test_the_joint_that_differs_most_is_plotted():
    """The third joint of the arm, with command, measured and simulated angle in degrees."""
    tracks = arm_tracks()
    joint = tracks.joint()
    assert joint == load_robot("arm").joints[2]
    (lines,) = lines_of(tracks, joint).values()
    assert [label for label, *_ in lines] == ["command", "measured", "simulated"]
    assert lines[1][2][0] - lines[2][2][0] == pytest.approx(np.degrees(0.3))


def test_the_cursor_is_where_the_time_is():
    """Two times differ in the columns of their cursors alone."""
    strip = Strip(arm_tracks(), size=(400, 600))
    changed = np.flatnonzero((strip.at(0.25) != strip.at(0.75)).any((0, 2)))
    left, right = 55, 580  # of the plots
    wanted = [left + (right - left) * share / 1.0 for share in (0.25, 0.75)]
    assert {round(min(abs(column - x) for x in wanted) / 4) for column in changed} == {0}


def test_a_overlay_is_seen_where_it_differs():
    """A overlay in the same place hides in the solid robot; one that is off shows its colour."""
    apart, alike = arm_tracks(), arm_tracks(late=0.0)
    model, red = apart.scene.compile(), [(1.0, 0.0, 0.0)]
    try:
        bare = draw_frames(model, apart.states(25.0)[0, :1], size=(240, 240))[0]
    except RenderError as error:
        pytest.skip(f"no driver draws here: {error}")
    seen = []
    for tracks in (apart, alike):
        drawn = draw_frames(model, tracks.states(25.0)[:, :1], size=(240, 240), overlays=red)[0]
        seen.append(int((np.abs(drawn.astype(int) - bare).max(-1) > 40).sum()))
    assert seen[0] > 200
    assert seen[1] < 0.2 * seen[0]


def test_a_film_has_all_pictures(tmp_path):
    """Three pictures are three frames of H.264, and no unfinished file stays."""
    av = pytest.importorskip("av")
    pictures = (np.full((64, 96, 3), shade, np.uint8) for shade in (0, 120, 240))
    path = write_film(pictures, tmp_path / "film.mp4", 30.0)
    with av.open(str(path)) as film:
        shades = [frame.to_ndarray(format="rgb24").mean() for frame in film.decode(video=0)]
    assert shades == pytest.approx([0, 120, 240], abs=4)
    assert [one.name for one in tmp_path.iterdir()] == ["film.mp4"]


def test_keys_play_scrub_and_change_the_speed():
    """Space pauses, right goes on half a second, up doubles the speed, a comma steps back; after 2 s it starts over."""
    player = Playback(2.0)
    player.key(32)
    player.advance(1.0)
    assert player.seconds == 0.0
    for code in (262, 265, 32):
        player.key(code)
    player.advance(0.5)
    assert (player.seconds, player.speed) == (1.5, 2.0)
    player.key(44)
    assert (player.seconds, player.playing) == (1.5 - 1 / RATE, False)
    player.key(32)
    player.advance(4.0)
    assert player.seconds == pytest.approx(1.5 - 1 / RATE)


def test_rerun_gets_robots_and_plots(tmp_path):
    """A recording names both robots and the plotted joint."""
    pytest.importorskip("rerun", reason="the extra `view` is not installed")
    from op3.report.rerun_recording import record

    tracks = arm_tracks()
    content = record(tracks, tmp_path / "log.rrd").read_bytes()  # type: ignore[union-attr]
    for name in ("robots/measured", "robots/simulated", f"plots/{tracks.joint()}/angle"):
        assert name.encode() in content


def test_joints_that_a_log_lacks_are_at_home():
    """A log of the knees alone is drawn with its whole limbs."""
    log = squat_log()
    states = Tracks({"measured": log}, scene_of(log)).states(25.0)
    assert states.shape == (1, 12, 12)


def test_a_policy_on_its_feet_has_no_overlay(tmp_path):
    """Its commands without what it felt make any simulation fall; a motion's do not."""
    log, told = simulate_motion(load_model("paper"), squat(duration=0.5), mount="floor"), []
    for rate in (None, 31.25):
        folder = Rollout(log.data, log.metadata.replace(policy_rate=rate)).save(tmp_path / str(rate))
        cfg = OmegaConf.create({"what": str(folder), "robot": None, "number": 0, "model": None})
        told.append(list(import_module("op3.apps.view").of_log(cfg).logs))
    assert told == [["measured", "simulated"], ["measured"]]


def test_a_policy_is_shown_with_its_card(tmp_path, capsys):
    """What the card says stands above its episode; without one it is said how to make it."""
    bundle = holding_bundle()
    folder, view = bundle.save(tmp_path / "bundle"), import_module("op3.apps.view")
    cfg = OmegaConf.create({"what": str(folder), "model": "paper", "seed": 0})
    view.show_card(cfg, folder)
    assert capsys.readouterr().out == f"{folder} has no card; op3 evaluate policy={folder} card=true writes one\n"
    Card("STANDS", bundle.fingerprint, "balance", "paper", 50, 0.0, 0.0).save(folder)
    view.show_card(cfg, folder)
    assert capsys.readouterr().out.startswith("STANDS\n---\n")


def test_a_folder_of_runs_is_answered_with_what_it_contains(tmp_path):
    """The newest first; an arbitrary log of another run would be taken for the one that was meant."""
    for age, name in enumerate(("b/log/metadata.yaml", "a/model.yaml", "a/shown/before/metadata.yaml")):
        file = tmp_path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.touch()
        os.utime(file, (1e9 - age, 1e9 - age))
    cfg = OmegaConf.create({"what": str(tmp_path), "number": 0, "robot": None})
    with pytest.raises(
        ValueError, match=f"what={tmp_path}: name one of {tmp_path}/b/log, {tmp_path}/a, the newest first"
    ):
        import_module("op3.apps.view").tracks_of(cfg)
