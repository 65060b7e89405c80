"""Which contact law do measured bounces of a tennis ball prefer, on three surfaces?

R. Cross, American Journal of Physics 70, 482 (2002): speed, angle and spin after a bounce, at 20 and 45 degrees, on
wood, emery cloth and Rebound Ace (data/cross2002_tennis.csv, through a transcription). Fitted per surface by least
squares through the simulator to both components of the velocity and to the spin times the radius, six numbers, whose
common spread is not known. Models are compared by Akaike's criterion for few data (AICc), undecided within 2.

    python experiments/studies/10_tennis_bounces.py [--out DIR]
"""

import argparse
import csv
import pathlib
import sys

import jax
import jax.numpy as jnp
import numpy as np

from nonholo_jax import Ball, BallState, Frictional, Plane, Rough, Scene, compare, fit
from nonholo_jax.plot import plot_fits

sys.path.append(str(pathlib.Path(__file__).parents[1]))  # for report.py
from report import Check, table

jax.config.update("jax_enable_x64", True)

DATA = pathlib.Path(__file__).parents[1] / "data"
RADIUS, MASS = 0.033, 0.057
INERTIA_RATIO = 0.55  # of a tennis ball, a thick shell (Cross)
LAW = "surfaces.ground.law."
LAWS = {
    "Rough, 1": (Rough(0.7), ("restitution",)),
    "Rough, 2": (Rough(0.7, tangential=0.2), ("restitution", "tangential")),
    "Frictional, 2": (Frictional(0.7, 0.0, 0.4), ("restitution", "friction")),
    "Frictional, 3": (Frictional(0.7, 0.2, 0.4), ("restitution", "tangential", "friction")),
}


def _rows() -> list[dict]:
    lines = [line for line in (DATA / "cross2002_tennis.csv").read_text().splitlines() if not line.startswith("#")]
    return [{k: x if k == "surface" else float(x) for k, x in row.items()} for row in csv.DictReader(lines)]


def _restitution(row: dict) -> float:
    rise, fall = (row[f"v_{w}"] * np.sin(np.radians(row[f"angle_{w}_deg"])) for w in ("out", "in"))
    return rise / fall


def bounces() -> dict[str, tuple[BallState, np.ndarray]]:
    """By surface: the ball just before it touches, and what was measured after (v along, v up, spin times radius)."""
    rows, found = _rows(), {}
    for surface in dict.fromkeys(row["surface"] for row in rows):
        own = [row for row in rows if row["surface"] == surface]
        angle = np.radians([row["angle_in_deg"] for row in own])
        speed = np.array([row["v_in"] for row in own])
        velocity = np.stack([speed * np.cos(angle), 0 * speed, -speed * np.sin(angle)], axis=-1)
        position = np.tile([0.0, 0.0, RADIUS], (len(own), 1))
        after = np.radians([row["angle_out_deg"] for row in own])
        out = np.array([row["v_out"] for row in own])
        spin = np.array([row["spin_out"] for row in own])
        measured = np.stack([out * np.cos(after), out * np.sin(after), RADIUS * spin], axis=-1)
        throws = BallState(jnp.asarray(position), jnp.asarray(velocity), jnp.zeros((len(own), 3)))
        found[surface] = throws, measured
    return found


def after(trajectory):
    """The ball flies along x, so that it turns about y."""
    log = trajectory.impacts.after
    return jnp.stack([log.velocity[0, 0], log.velocity[0, 2], RADIUS * log.spin[0, 1]])


def fits(throws: BallState, measured: np.ndarray, *names: str) -> dict:
    found = {}
    for name in names or LAWS:
        law, free = LAWS[name]
        scene = Scene(Ball(RADIUS, MASS, INERTIA_RATIO), {"ground": Plane((0, 0, 0), (0, 0, 1), law)})
        options = {"observe": after, "t1": 1e-3, "max_impacts": 1}
        found[name] = fit(scene, throws, measured, free=[LAW + each for each in free], **options)
    return found


def checks(names: tuple[str, ...] | None = None) -> list[Check]:
    """What the fit must agree with: the two coefficients of the rough ball are linear in the data, so that their least
    squares have closed forms, and the restitution that Cross printed follows from his speeds and angles."""
    by_surface = {name: data for name, data in bounces().items() if names is None or name in names}
    rows = []
    for surface, (throws, measured) in by_surface.items():
        found = fits(throws, measured, "Rough, 2")["Rough, 2"]
        arriving = np.asarray(throws.velocity)
        e_n = -(measured[:, 1] @ arriving[:, 2]) / (arriving[:, 2] @ arriving[:, 2])
        # v+ = v - k (1 + e_t) v and R w+ = (1 - k) (1 + e_t) v, of a ball that does not spin, k = alpha / (1 + alpha)
        k, along = INERTIA_RATIO / (1.0 + INERTIA_RATIO), arriving[:, 0]
        slope = np.concatenate([-k * along, (1.0 - k) * along])
        rest = np.concatenate([measured[:, 0] - along, measured[:, 2]])
        e_t = rest @ slope / (slope @ slope) - 1.0
        rows.append(Check(f"{surface}: restitution, against its closed form", abs(found.values[0] - e_n), 1e-8))
        rows.append(Check(f"{surface}: tangential, against its closed form", abs(found.values[1] - e_t), 1e-8))
    printed = max(abs(row["e_y"] - _restitution(row)) for row in _rows())
    return [*rows, Check("restitution that Cross printed, against his speeds and angles", printed, 0.01)]


def main() -> int:
    parser = argparse.ArgumentParser(description=str(__doc__).splitlines()[0])
    parser.add_argument("--out", default="nonholo-out/10_tennis_bounces")
    options = parser.parse_args()
    code = table("Bounces of a tennis ball", checks())
    every = {}
    for surface, (throws, measured) in bounces().items():
        found = every[surface] = fits(throws, measured)
        preferred = compare(found)
        print(f"\n{surface}: {preferred.verdict}")
        for name, each in found.items():
            numbers = ", ".join(line.removeprefix(LAW) for line in each.report())
            apart, weight = preferred.differences[name], preferred.weights[name]
            print(f"  {name:14} AICc +{apart:5.1f}  weight {weight:5.1%}  spread {each.spread:.3f} m/s  {numbers}")
    folder = pathlib.Path(options.out)
    folder.mkdir(parents=True, exist_ok=True)
    rows = [f"{angle}\N{DEGREE SIGN} {what}" for angle in (20, 45) for what in ("along", "up", "spin")]
    plot_fits(every, rows=rows, unit="m/s", path=folder / "residuals.png")
    print(f"\npicture: {folder / 'residuals.png'}")
    return code


if __name__ == "__main__":
    sys.exit(main())
