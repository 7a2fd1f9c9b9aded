"""The loss of the gear by the direction of power."""

import torch

from op3.servo import law

FORWARD_LOSS, BACKWARD_SHARE = torch.tensor(0.1), torch.tensor(0.25)


def loss(motor: float, load: float, velocity: float) -> float:
    """Bound of the friction [N m]."""
    tensors = (torch.tensor(value) for value in (motor, load, velocity))
    return float(law.dte_power_loss(*tensors, FORWARD_LOSS, BACKWARD_SHARE))


def test_loss_follows_the_direction_of_power():
    """A motor of 2 N m that drives loses 0.2; driven back it loses 0.5, whichever way the load points."""
    for load in (-5.0, 0.0, 5.0):
        assert round(loss(2.0, load, 1.0), 6) == 0.2
        assert round(loss(2.0, load, -1.0), 6) == 0.5


def test_at_rest_the_stronger_torque_says_which():
    """A joint that a larger load pulls against the motor loses as if driven back, one that the motor holds does not."""
    assert round(loss(2.0, -3.0, 0.0), 6) == 0.5
    assert round(loss(2.0, -1.0, 0.0), 6) == 0.2


def test_loss_is_symmetrical():
    """Turned round, motor, load and motion lose the same."""
    assert loss(2.0, -3.0, 0.7) == loss(-2.0, 3.0, -0.7)
