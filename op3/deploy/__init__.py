"""Running a policy on the robot: the bus, safety, the 125 Hz loop, and an emulated robot that speaks the same bytes."""

from op3.deploy.connection import Connection, Plan, calibrate, connect, read_only, run, setup
from op3.deploy.dynamixel_bus import Bus
from op3.deploy.exit_codes import ExitCode, Stop
from op3.deploy.limits import Command, Limits
from op3.deploy.phases import FollowMotion, HoldPose
from op3.deploy.players import Player
from op3.deploy.policy_runner import FollowPolicy, PolicyRunner, replay_policy
from op3.deploy.robot_state import Calibration, RobotState
from op3.deploy.session import SessionOutcome

__all__ = [
    "Bus",
    "Calibration",
    "Command",
    "Connection",
    "ExitCode",
    "FollowMotion",
    "FollowPolicy",
    "HoldPose",
    "Limits",
    "Plan",
    "Player",
    "PolicyRunner",
    "RobotState",
    "SessionOutcome",
    "Stop",
    "calibrate",
    "connect",
    "read_only",
    "replay_policy",
    "run",
    "setup",
]
