"""MuJoCo's own Python on the model and the work of benches/rollouts.rs: a loop of mj_step, mujoco.rollout, mujoco.batch.

    cargo bench -p emp-sim -- --save emp27.mjb
    python -m venv venv && venv/bin/pip install mujoco==3.17.0
    venv/bin/python sim/benches/reference.py emp27.mjb

Run it right before or after `cargo bench -p emp-sim` on the same quiet machine. Prints medians of interleaved rounds.
"""

import statistics
import sys
import threading
import time

import mujoco
import numpy as np
from mujoco import rollout
from mujoco.batch import Batch

BODIES, PERIODS, ROUNDS = 256, 20, 15
SUBSTEPS = 4


def standing(model):
    """State in which the robot stands in its default pose, and the servo targets that hold it there."""
    data = mujoco.MjData(model)
    targets = np.array([DEFAULT.get(model.actuator(i).name, 0.0) for i in range(model.nu)])
    data.qpos[3] = 1.0
    for actuator, target in enumerate(targets):
        data.qpos[model.jnt_qposadr[model.actuator_trnid[actuator, 0]]] = target
    mujoco.mj_kinematics(model, data)
    feet = [g for g in range(model.ngeom) if model.geom_contype[g] == 1]
    data.qpos[2] = -min(data.geom_xpos[g, 2] - model.geom_size[g, 0] for g in feet)
    return data.qpos.copy(), targets


# emp27's default pose, rad.
DEFAULT = {"left_shoulder_roll": 0.15, "right_shoulder_roll": -0.15}
for side in ("left", "right"):
    DEFAULT |= {f"{side}_shoulder_pitch": 0.2, f"{side}_elbow": -0.6}
    DEFAULT |= {f"{side}_hip_pitch": -0.23, f"{side}_knee": 0.5, f"{side}_ankle_pitch": -0.27}


def loop(model, qpos, targets, threads):
    """Every thread steps one data; the interpreter's lock is free while it does."""
    datas = [mujoco.MjData(model) for _ in range(threads)]

    def work(data):
        for _ in range(BODIES // threads):
            data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = qpos, 0, 0
            data.ctrl[:] = targets
            mujoco.mj_step(model, data, PERIODS * SUBSTEPS)

    def run():
        workers = [threading.Thread(target=work, args=(data,)) for data in datas]
        [worker.start() for worker in workers]
        [worker.join() for worker in workers]

    return run


def rollouts(model, qpos, targets, threads):
    """The whole open loop in one call: no observation or action in between."""
    datas = [mujoco.MjData(model) for _ in range(threads)]
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    full = mujoco.mjtState.mjSTATE_FULLPHYSICS
    state = np.empty(mujoco.mj_stateSize(model, full))
    mujoco.mj_getState(model, data, state, full)
    states = np.tile(state, (BODIES, 1))
    control = np.tile(targets, (BODIES, PERIODS * SUBSTEPS, 1))
    runner = rollout.Rollout(nthread=threads)
    return lambda: runner.rollout(model, datas, states, control)


def batch(model, qpos, targets, threads):
    """A data an environment; one call a physics step, as often as targets may change within it."""
    group = Batch(model, BODIES, threads)
    position, velocity, warm = (group.bind(n) for n in ("qpos", "qvel", "qacc_warmstart"))
    control = group.bind("ctrl")

    def run():
        position[:], velocity[:], warm[:], control[:] = qpos, 0, 0, targets
        for _ in range(PERIODS * SUBSTEPS):
            group.step()

    return run


def main():
    model = mujoco.MjModel.from_binary_path(sys.argv[1])
    qpos, targets = standing(model)
    for threads in (1, 2):
        kinds = {"mj_step loop": loop, "mujoco.rollout": rollouts, "mujoco.batch": batch}
        runs = {name: kind(model, qpos, targets, threads) for name, kind in kinds.items()}
        times = {name: [] for name in runs}
        for _ in range(ROUNDS):
            for name, run in runs.items():
                start = time.perf_counter()
                run()
                times[name].append(time.perf_counter() - start)
        for name, measured in times.items():
            ratios = [bare / time for bare, time in zip(times["mj_step loop"], measured)]
            rate = BODIES * PERIODS * SUBSTEPS / statistics.median(measured)
            ratio = statistics.median(ratios)
            print(f"{threads} thread(s)  {name:16} {rate:8.0f} mj_step/s   ratio {ratio:.3f}")


main()
