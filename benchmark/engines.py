#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
Grade physics engines and integrators, each as its documentation uses it:

    make engines

Every row of the page is a process of its own, so that one engine cannot disturb another.
"""

from __future__ import annotations

import argparse
import importlib
import json
import math
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import report
from scipy.spatial.transform import Rotation

from spinning_top_sim.grade import grade
from spinning_top_sim.grade.scenes import SCENES
from spinning_top_sim.physics.states import relative_drift

PACKAGES = ('numpy', 'mujoco', 'mujoco-mjx', 'drake', 'pin', 'pybullet', 'dartpy', 'newton',
            'scipy', 'heyoka', 'diffrax', 'jax')
FINER = 4           # times as many steps
LIMIT = 1800        # seconds that a row may take
TOGETHER = 2        # rows


@dataclass(frozen=True)
class Entry:
    """
    A row of the table.

    place : module in benchmark/engines/, and what `grade` runs
    dt : step, or time between samples [s]
    given : options of the class in that place, before it runs
    options : of each run
    setting : what the table says about the step
    whole : whether all scenes are graded, or the first one only
    """

    name: str
    place: str
    dt: float
    setting: str
    given: dict[str, Any] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)
    whole: bool = True

    @property
    def key(self) -> str:
        return f'{self.name}, {self.setting}'


def stepped(name: str, place: str, dt: float, given: dict[str, Any] | None = None,
            **options: Any) -> Iterator[Entry]:
    """Yield an engine at its step and at a finer one."""
    entry = Entry(name, place, dt, f'{1e3 * dt:.3g} ms', given or {}, options)
    yield entry
    yield replace(entry, dt=dt / FINER, setting=f'{1e3 * dt / FINER:.3g} ms', whole=False)


def tolerant(name: str, place: str, finer: dict[str, float],
             **options: Any) -> Iterator[Entry]:
    """Yield an integrator at its default tolerance and at a finer one."""
    entry = Entry(name, place, 0.002, 'default', {}, options)
    yield entry
    if finer:
        yield replace(entry, setting=', '.join(f'{key} {value:g}' for key, value in finer.items()),
                      options={**options, **finer}, whole=False)


FINE = {'rtol': 1e-10, 'atol': 1e-12}
# Steps are the defaults of MuJoCo, Bullet and DART.  Drake and Pinocchio have none: theirs are
# those of their examples.  The examples of Newton take ten steps in 1/60 s.
ENTRIES = (
    *(entry for integrator in ('Euler', 'implicit', 'implicitfast', 'RK4') for entry in stepped(
        f'MuJoCo {integrator}', 'mujoco_engine:run', 0.002, integrator=integrator)),
    *stepped('Pinocchio', 'pinocchio_engine:run', 0.001),
    *stepped('Bullet', 'bullet_engine:run', 1.0 / 240.0),
    *(entry for method in ('RK45', 'DOP853', 'LSODA') for entry in tolerant(
        f'SciPy {method}', 'integrators:scipy', FINE, method=method)),
    *tolerant('heyoka', 'integrators:heyoka', {}),
    *stepped('diffrax Tsit5, single precision', 'integrators:Diffrax', 0.002,
             {'method': 'Tsit5', 'double': False}),
    *stepped('diffrax Tsit5, double precision', 'integrators:Diffrax', 0.002,
             {'method': 'Tsit5'}),
    *stepped('DART', 'dart_engine:run', 0.001),
    *stepped('Drake discrete', 'drake_engine:run', 0.001),
    Entry('Drake RK3', 'drake_engine:run', 0.002, 'accuracy 1e-4', options={'accuracy': 1e-4}),
    Entry('Drake RK3', 'drake_engine:run', 0.002, 'accuracy 1e-10', options={'accuracy': 1e-10},
          whole=False),
    *stepped('MJX Euler', 'mujoco_engine:Mjx', 0.002, integrator='Euler'),
    *stepped('Newton Featherstone', 'newton_engine:run', 1.0 / 600.0, solver='Featherstone'))


class Timed:
    """
    Runs an engine twice; adds up the processor time of the second run.

    drift : of the energy, relative to that at the start, in the first motion
    """

    def __init__(self, entry: Entry) -> None:
        module, name = entry.place.split(':')
        made = getattr(importlib.import_module(f'engines.{module}'), name)
        self._run = made(**entry.given) if isinstance(made, type) else made
        self._entry = entry
        self.spent, self.simulated, self.drift = 0.0, 0.0, math.nan

    def __call__(self, top: Any, start: Any, times: Any, dt: float) -> Any:
        self._run(top, start, times, dt, **self._entry.options)     # something may be compiled
        began = time.process_time()
        said = self._run(top, start, times, dt, **self._entry.options)
        self.spent += time.process_time() - began
        self.simulated += times[-1]
        if math.isnan(self.drift):
            up = Rotation.from_quat(said['attitudes']).as_matrix()[:, 2, 2]
            energy = (0.5 * np.square(said['rates']) @ np.array(top.inertia)
                      + top.gravity_torque * up)
            self.drift = float(np.max(np.abs(relative_drift(energy, float(energy[0])))))
        return said


def measured(entry: Entry) -> dict[str, Any]:
    """Return what the table has of an engine."""
    run = Timed(entry)
    found = grade(run, dt=entry.dt, scenes=SCENES if entry.whole else SCENES[:1])
    cost, first = run.spent / run.simulated if run.simulated else math.nan, SCENES[0].name
    error, order = found.measures.get(f'total_error_deg: {first}', math.nan), math.nan
    # Elsewhere the step is not dt, or the error is rounding.
    if entry.whole and error > 1e-6 and entry.setting != 'default' and (
            entry.options.keys().isdisjoint({'accuracy', 'rtol'})):
        finer = grade(run, dt=0.5 * entry.dt, scenes=SCENES[:1]).measures
        order = math.log2(error / finer.get(f'total_error_deg: {first}', math.nan))
    return {'total_error_deg': error, 'energy_drift': run.drift, 'order': order, 'cost': cost,
            'faults': found.faults, 'text': f'{entry.key}: {found}'}


def row(entry: Entry) -> tuple[str, ...]:
    command = [sys.executable, __file__, '--only', entry.key]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT, check=True)
        found = json.loads(done.stdout.splitlines()[-1])
    except (subprocess.SubprocessError, ValueError, IndexError) as error:
        print(getattr(error, 'stderr', None) or error, file=sys.stderr)
        return entry.name, entry.setting, *4 * ('–',), 'does not run here'
    print(found['text'], flush=True)
    numbers = [found[name] for name in ('total_error_deg', 'energy_drift', 'order')]
    return (entry.name, entry.setting, *(report.number(None if math.isnan(value) else value)
                                         for value in (*numbers, 1e3 * found['cost'])),
            ', '.join(f'`{name}`' for name in found['faults']) or 'none')


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument('--only', choices=[entry.key for entry in ENTRIES], metavar='ROW',
                        help='grade one, and print a line of JSON')
    wanted = parser.parse_args().only
    if wanted:
        print(json.dumps(measured(next(entry for entry in ENTRIES if entry.key == wanted))))
        return
    heads = ('engine', 'step', 'error [deg]', 'energy drift', 'order', 'ms', 'faults')
    head, rows = report.preamble('Engines and integrators', PACKAGES), []
    with ThreadPoolExecutor(TOGETHER) as pool:
        for found in pool.map(row, ENTRIES):        # whoever stops it keeps the rows before
            rows.append(found)
            report.write('engines.md', f'{head}\n{TEXT}\n\n{report.table(heads, rows)}\n{NOTES}')


TEXT = f"""\
A bicycle wheel on a ball joint moves for 10 s on cusps, the first scene of `grade`. `error` is
the largest angle to the exact attitude, `energy drift` is relative to the energy at the start,
`order` is that in which the error falls with the step, and `ms` is the processor time of a
simulated second, with a sample read after every step from Python. `faults` are those that `grade`
names with a tolerance of 0.1 degrees: in all scenes at the first step, in the cusps alone at the
finer one, 1/{FINER} of it.

Every engine runs as its documentation shows. The first step is the default where there is one,
else that of its examples. Damping that is on by default is switched off, as the top has none. A
first-order step is no mistake of an engine: it is chosen for robustness with contacts, which this
page does not measure, and a finer step or another integrator is the remedy. `late`
means that readings belong to the state before the step: they are consistent with that pose.
Tolerances hold for one step of an integrator, so that the error after 10 s is larger."""
NOTES = """\
- MJX tells accelerations only in models that have a constraint (google-deepmind/mujoco#3440).
- Drake's ball joint has roll, pitch and yaw as coordinates. A discrete step adds their rates,
  which are large near a pitch of 90 degrees; the error control of RK3 takes shorter steps there.
- Bullet has no IMU, and that of Newton needs a solver that tells accelerations: both are graded
  without one.
- JAX and Warp compile at first; `ms` leaves it out.
- Of Newton's solvers, MuJoCo asks for MuJoCo 3.17, and a ball joint set up for SemiImplicit and
  XPBD has not been verified: they are left out.
- Genesis cannot be installed beside these versions, and the engine of Brax is MJX.
"""


if __name__ == '__main__':
    main()
