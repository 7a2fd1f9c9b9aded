"""An emulated ROBOTIS-OP3 on a serial port: prints the port, and serves until Ctrl-C.

python experiments/emulate_robot.py [world=eta_060] [scene=floor] [faults.lost=0.0026] [record=frames.txt]
python experiments/emulate_robot.py model=paper scene=floor
"""

import hydra
from omegaconf import DictConfig
from support import one_sentence, seeded_faults

from op3.deploy.emulator import (
    Battery,
    EmulatedRobot,
    Physics,
    SimPhysics,
    StandInPhysics,
    Timing,
)
from op3.robot import pose
from op3.sim import load_model
from op3.stand_in import World


def physics(cfg: DictConfig) -> Physics:
    """The robot behind the bus."""
    start = None if cfg.scene == "bench" else pose(cfg.pose)
    if cfg.model is None:
        world = World.find(cfg.world, cfg.world_seed)
        return StandInPhysics(world, cfg.scene, seed=cfg.seed, joint_position=start)
    model = load_model(cfg.model)
    return SimPhysics(model, cfg.scene, seed=cfg.seed, joint_position=start, battery=Battery(charge=float(cfg.battery)))


def robot(cfg: DictConfig) -> EmulatedRobot:
    """The robot, its bus and what goes wrong."""
    return EmulatedRobot(
        physics(cfg),
        seed=cfg.seed,
        faults=seeded_faults(cfg.faults),
        timing=Timing(latency_timer=float(cfg.latency_timer)),
        settings={"baud_rate": 4, "return_delay_time": int(cfg.return_delay_time)},
        record=cfg.record,
    )


@hydra.main(version_base="1.3", config_path="../conf", config_name="emulate_robot")
def main(cfg: DictConfig) -> None:
    """Build the robot and serve it."""
    with one_sentence():
        emulated = robot(cfg)
    with emulated.serve_pty(cfg.baud) as server:
        print(f"port: {server.path}", flush=True)
        print("the servos have power once 1 is written to register 24 of the OpenCR, id 200; Ctrl-C ends", flush=True)
        try:
            server.wait(cfg.duration)
        except KeyboardInterrupt:
            print()
    emulated.close()
    print(f"emulated {emulated.time:.1f} s; at most {1e3 * server.longest_lag:.0f} ms behind the wall clock")


if __name__ == "__main__":
    main()
