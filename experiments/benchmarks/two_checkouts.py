"""Compare the speed of environments in two checkouts: policy steps of balancing OP3s on one thread, alternately.

python experiments/benchmarks/two_checkouts.py ../before . [robots=32]
"""

import argparse
import os
import statistics
import subprocess
import sys

ROUNDS = 7

CHILD = """
import sys, time, torch
from op3.envs import make_env
torch.set_num_threads(1)
env = make_env("balance", num_envs={robots}, num_threads=1)
stand = torch.from_numpy(env.action_map.stand()).float().expand({robots}, -1)

def work(steps=15):
    state, wall, processor = env.reset(), time.perf_counter(), time.process_time()
    for _ in range(steps):
        state["action"] = stand
        _, state = env.step_and_maybe_reset(state)
    print((time.perf_counter() - wall) / steps, (time.process_time() - processor) / steps, flush=True)

work()
for _ in sys.stdin:
    work()
"""
"""Program that both checkouts run: a warm-up, then the same number of steps for every line of input."""


def main() -> None:
    """Measure alternately, so that drift of the machine's speed affects both, and print medians of ratios."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("before", help="folder of the first checkout")
    parser.add_argument("after", help="folder of the second checkout")
    parser.add_argument("robots", type=int, nargs="?", default=32, help="number of robots simulated in parallel")
    args = parser.parse_args()
    command, alone = [sys.executable, "-c", CHILD.format(robots=args.robots)], {"OMP_NUM_THREADS": "1"}
    children = [
        subprocess.Popen(
            command, cwd=folder, env={**os.environ, **alone, "PYTHONPATH": "."}, text=True, stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        for folder in (args.before, args.after)
    ]  # fmt: skip

    def answer(child: subprocess.Popen[str]) -> list[float]:
        assert child.stdout is not None
        line = child.stdout.readline()
        if not line:
            sys.exit(f"{child.args!r} ended early")
        return [float(value) / args.robots for value in line.split()]

    def asked(child: subprocess.Popen[str]) -> list[float]:
        assert child.stdin is not None
        child.stdin.write("go\n")
        child.stdin.flush()
        return answer(child)

    for child in children:
        answer(child)
    rows = [[asked(child) for child in children] for _ in range(ROUNDS)]
    print(f"load of the machine: {os.getloadavg()[0]:.1f} on {os.cpu_count()} processors")
    for clock, name in enumerate(("wall time", "processor time")):
        before, after = zip(*([own[clock] for own in row] for row in rows), strict=True)
        ratios = [b / a for b, a in zip(before, after, strict=True)]
        print(
            f"{name}: {1 / statistics.median(before):.0f} policy steps/s before, {1 / statistics.median(after):.0f}"
            f" after, ratio {statistics.median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})"
        )


if __name__ == "__main__":
    main()
