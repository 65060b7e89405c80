"""What air does to a flying, spinning ball."""

import math
from typing import Any

import equinox as eqx

from .._math import (
    Number,
    Vector3,
    add,
    as_number,
    as_vector,
    components,
    cross,
    is_constant,
    norm,
    scale,
    subtract,
    times,
)
from .ball import Ball


class Air(eqx.Module):
    """Drag and Magnus force; the spin itself is not slowed. With u = velocity - wind and A = pi r^2,

        F = -(density A drag / 2) |u| u  +  (density A lift r / 2) omega x u

    **Arguments:**

    - `density`: in kg/m^3, >= 0. 1.204 is dry air at 20 degrees C and 1 atm.
    - `drag`: C_D >= 0. 0.47 is a smooth sphere at Reynolds numbers of 1e3 to 2e5 (Hoerner, Fluid-Dynamic Drag, 1965).
    - `lift`: c in C_L = c r |omega| / |u|, the lift coefficient per spin parameter. 1.0 is close to what is measured
        on rough balls at spin parameters up to 0.3 (Nathan, Am. J. Phys. 76, 119 (2008)); smooth balls have less.
    - `wind`: velocity of the air in m/s, shape (3,).

    ```python
    from nonholo_jax import Air
    still = Air()
    headwind = Air(drag=0.5, wind=(-3.0, 0.0, 0.0))
    ```
    """

    density: Number = eqx.field(converter=as_number, default=1.204)
    drag: Number = eqx.field(converter=as_number, default=0.47)
    lift: Number = eqx.field(converter=as_number, default=1.0)
    wind: Any = eqx.field(converter=as_vector, default=(0.0, 0.0, 0.0))

    def __check_init__(self):
        for name in ("density", "drag"):
            value = getattr(self, name)
            if is_constant(value) and not 0 <= value < float("inf"):
                raise ValueError(f"Argument `{name}` must be finite and not negative, but got {value}; use SI units.")

    def acceleration(self, ball: Ball, velocity: Vector3, spin: Vector3) -> Vector3:
        """The acceleration in m/s^2 that air gives to the ball, by components."""
        u = subtract(velocity, components(self.wind))
        pressure = times(self.density, 0.5 * math.pi * ball.radius**2 / ball.mass)
        drag = scale(times(-1.0, times(times(pressure, self.drag), norm(u))), u)
        return add(drag, scale(times(times(pressure, self.lift), ball.radius), cross(spin, u)))
