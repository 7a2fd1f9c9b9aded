"""Exit codes of the process, by how a run on the robot ended."""

from enum import IntEnum


class ExitCode(IntEnum):
    """Exit codes of `experiments/deploy.py`.

    Codes 10 to 12: nothing was energised. 13: torque may have been on for a moment and is off again. From 20 on: the
    loop was running, with torque unless the mode has none, and ended early for this reason; torque was switched off and
    read back. 40: switch the battery off by hand.
    """

    OK = 0
    """The run ended as planned."""
    USAGE = 1
    """A wrong argument or file; the message states which."""
    START_CHECK = 10
    """A start check failed; nothing was energised."""
    DECLINED = 11
    """The operator did not confirm; nothing was energised."""
    PORT = 12
    """The port could not be opened."""
    ENERGISE = 13
    """A servo did not accept the settings that are required before torque; torque is off."""
    FALL = 20
    """Roll or pitch stayed beyond the limit."""
    BUS_LOSS = 21
    """A servo or the IMU did not answer for 96 ms."""
    UNPLUGGED = 22
    """The serial port disappeared."""
    IMU_FROZEN = 23
    """The IMU repeated the same block."""
    SERVO_SHUTDOWN = 24
    """A servo reported a hardware error and shut itself down."""
    TEMPERATURE = 25
    """A servo is too hot."""
    VOLTAGE = 26
    """The supply voltage is too low."""
    NON_FINITE = 27
    """The policy or the controller commanded a value that is not finite."""
    OVERRUN = 28
    """The loop was blocked so long that the servos' watchdogs switched torque off."""
    POSITION_JUMP = 29
    """A position moved faster than its servo can: a turn was lost, or a counter was reset."""
    ERROR = 30
    """An unexpected error, printed above."""
    SELF_COLLISION = 31
    """Parts of the robot were about to collide at its measured or commanded angles."""
    TORQUE_LOST = 32
    """A servo delivers no current at its goal: another program switched its torque off, or its motor is broken."""
    NOT_VERIFIED = 40
    """Torque off could not be read back from every servo: switch the power off by hand."""
    REPLAY = 50
    """A replay of a log gave other actions than recorded."""
    HANGUP = 129
    """SIGHUP: the terminal was closed; torque was switched off."""
    INTERRUPTED = 130
    """SIGINT (Ctrl-C); torque was switched off."""
    QUIT = 131
    """SIGQUIT; torque was switched off."""
    TERMINATED = 143
    """SIGTERM; torque was switched off."""


class Stop(Exception):
    """Raised to end a run for a reason.

    Args:
        damp: whether the joints are damped for some time before torque is switched off.
    """

    def __init__(self, code: ExitCode, reason: str, *, damp: bool = False):
        self.code, self.reason, self.damp = code, reason, damp
        super().__init__(reason)
