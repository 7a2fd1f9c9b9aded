"""Serve an emulated robot on a serial port until Ctrl-C; the first line printed is the port.

op3 emulate [world=eta_060] [scene=floor] [faults.lost=0.0026] [record=frames.txt]
op3 emulate model=paper scene=floor
op3 emulate robot=path/to/my_robot.yaml model=own
"""

import math
import signal
import sys
import time
from collections.abc import Callable

from omegaconf import DictConfig

from op3.apps.job import one_sentence
from op3.apps.support import seeded_faults
from op3.deploy.emulated import physics_maker
from op3.deploy.emulator import EmulatedRobot, LineTiming, PtyServer
from op3.deploy.operator import quietly
from op3.robot import load_robot

WATCH_EVERY = 0.5
"""Interval at which the lag of the emulation is checked [s]."""

LARGEST_LAG = 0.03
"""Lag above which a warning is printed [s]: all answers of a sync read are then too late."""


def robot(cfg: DictConfig) -> EmulatedRobot:
    """The robot, its bus and its faults."""
    chosen = {name: cfg[name] for name in ("world", "world_seed", "model", "seed")}
    make, _ = physics_maker(cfg.robot, **chosen)
    return EmulatedRobot(
        make(cfg.scene, None if cfg.scene == "bench" else load_robot(cfg.robot).pose(cfg.pose)),
        seed=cfg.seed,
        faults=seeded_faults(cfg.faults),
        timing=LineTiming(latency_timer=float(cfg.latency_timer)),
        settings={"baud_rate": 4, "return_delay_time": int(cfg.return_delay_time)},
        record=cfg.record,
    )


def ending_signals() -> set[signal.Signals]:
    """The signals that end the server; they are blocked until `watch` handles them."""
    ends = {signal.SIGINT, signal.SIGTERM, signal.SIGHUP}
    if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:  # started with `nohup`: keep running without the terminal
        ends.remove(signal.SIGHUP)
    signal.pthread_sigmask(signal.SIG_BLOCK, ends)
    return ends


def watch(server: PtyServer, duration: float | None, ends: set[signal.Signals], say: Callable[[str], None]) -> None:
    """Wait until the server ends; warn once if the machine is too busy to answer in time."""
    end, warned = math.inf if duration is None else time.monotonic() + duration, False
    while server.alive and (left := end - time.monotonic()) > 0:
        if signal.sigtimedwait(ends, min(WATCH_EVERY, left)) is not None:
            break
        if server.longest_lag > LARGEST_LAG and not warned:
            warned = True
            say(
                f"{1e3 * server.longest_lag:.0f} ms behind the wall clock: this machine is too busy, so a program on"
                " the port gets late answers from the servos or none"
            )
    server.wait(0.0)  # raises the error that ended the server


def main(cfg: DictConfig) -> None:
    """Build the robot and serve it."""
    ends, say = ending_signals(), quietly(lambda text: print(text, flush=True))
    with one_sentence():
        emulated = robot(cfg)
    failure = ""
    with PtyServer(emulated, cfg.baud) as server:
        say(f"port: {server.path}")
        if load_robot(cfg.robot).file.board is not None:
            say("write 1 to register 24 of the OpenCR (id 200) to power the servos; Ctrl-C ends the server")
        try:
            watch(server, cfg.duration, ends, say)
        except Exception as error:
            failure = f"the emulated robot has stopped: {error}"
    try:
        emulated.close()
    except OSError as error:
        failure = failure or f"the recording of frames is incomplete: {error}"
    say(f"emulated {emulated.time:.1f} s; at most {1e3 * server.longest_lag:.0f} ms behind the wall clock")
    if failure:
        print(failure, file=sys.stderr)
        raise SystemExit(1)
