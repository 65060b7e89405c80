"""The table that every script prints, and the folder and manner of its picture."""

import pathlib
import platform
from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

import diffrax
import jax

from nonholo_jax import law_residual, weak_residual

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Okabe and Ito's colours, which colour-blind readers can tell apart.
INK, BLUE, VERMILION, GREEN, PURPLE, ORANGE, FAINT = (
    "#222222", "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#9a9a9a",
)  # fmt: skip


class Check(NamedTuple):
    """One line of a table: a number, and the bound that it must stay below (or, if `above`, exceed)."""

    what: str
    value: float
    bound: float
    above: bool = False
    unit: str = ""

    @property
    def passes(self) -> bool:
        """A NaN does not."""
        return self.value > self.bound if self.above else self.value <= self.bound


def residuals(system, trajectory) -> list[Check]:
    """The paper's definition (2.4), and its law (6.1), asked of a motion of a LagrangianSystem."""
    return [
        Check("weak_residual, (2.4)", float(weak_residual(system, trajectory)), 1e-9),
        Check("law_residual, (6.1)", float(law_residual(system, trajectory)), 1e-12),
    ]


def machine() -> str:
    """What the numbers were computed with."""
    device = jax.devices()[0].device_kind
    versions = f"Python {platform.python_version()}, JAX {jax.__version__}, Diffrax {diffrax.__version__}"
    return f"{device}, {platform.machine()}, {versions}"


def table(title: str, checks: Iterable[Check]) -> int:
    """Print the checks; 1 if one of them fails, else 0: the exit code of a script."""
    checks = list(checks)
    width = max(len(check.what) for check in checks)
    print(f"{title}\n{machine()}\n{'':{width}}  {'value':>9}    {'bound':>9}")
    for check in checks:
        sign, word = ">" if check.above else "<", "pass" if check.passes else "FAIL"
        print(f"{check.what:{width}}  {check.value:9.2e}  {sign} {check.bound:9.2e}  {word}  {check.unit}".rstrip())
    failed = sum(not check.passes for check in checks)
    print(f"{len(checks) - failed} of {len(checks)} pass" + (f", {failed} FAIL" if failed else "") + "\n")
    return int(failed > 0)


def figure(width: float, height: float, *shape: int, **options) -> tuple:
    """A figure in inches, and its axes, with little ink."""
    from matplotlib.figure import Figure

    new = Figure(figsize=(width, height), layout="constrained")
    axes = new.subplots(*(shape or (1, 1)), **options)
    for ax in getattr(axes, "flat", [axes]):
        ax.spines[["top", "right"]].set_visible(False)
        ax.tick_params(labelsize=8)
    return new, axes


def save(picture: "Figure", name: str) -> None:
    """Write a picture to nonholo-out/NAME/NAME.png."""
    folder = pathlib.Path("nonholo-out") / name
    folder.mkdir(parents=True, exist_ok=True)
    picture.savefig(folder / f"{name}.png", dpi=200)
    print(f"picture: {folder / f'{name}.png'}")
