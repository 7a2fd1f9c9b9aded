"""The search for the numbers of a walk."""

import dataclasses

import numpy as np

from op3.envs import make_env
from op3.envs.gait_search import BOUNDS, SCALES, Generation, search
from op3.policy import ActionMap
from op3.robot import asset_path
from op3.tasks import Stride, find_task


def test_a_search_keeps_to_its_bounds_and_repeats_itself():
    """The same seed finds the same numbers; bounded ones stay in their bounds, and gains as they were."""
    env = make_env(find_task("walk", duration=0.5), "paper", 4, action_map=ActionMap.around_stand(0.8))
    start = dataclasses.replace(Stride(), crouch=BOUNDS["crouch"][0], stance_gain=5.5)
    seen: list[Generation] = []
    first = search(env, start, 2, spread=1.0, noise=0.02, seed=3, say=seen.append)
    again = search(env, start, 2, spread=1.0, noise=0.02, seed=3)
    assert first == again == seen[-1].mean
    assert first != start
    assert first.stance_gain == 5.5
    assert all(low <= getattr(first, name) <= high for name, (low, high) in BOUNDS.items())


def test_the_score_rewards_walking():
    """A robot that walks scores more than one that only lifts its feet in place, and both more than one that falls."""
    env = make_env(find_task("walk", duration=2.0), "paper", 4, action_map=ActionMap.around_stand(0.8))
    stride, scores = Stride.load(asset_path("gaits/walk.yaml")), {}
    for name, change in {"walk": {}, "in place": {"step": 0.0}, "fall": {"lean": 1.0}}.items():
        seen: list[Generation] = []
        search(env, dataclasses.replace(stride, **change), 1, spread=1e-3, say=seen.append)
        scores[name] = float(np.mean(seen[0].score))
    assert scores["walk"] > scores["in place"] > scores["fall"]


def test_every_varied_number_is_one_of_the_walk():
    """Scales and bounds name numbers of a stride."""
    assert set(BOUNDS) <= set(SCALES) <= {field.name for field in dataclasses.fields(Stride)}
