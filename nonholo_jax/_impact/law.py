"""Contact laws of a rough ball in closed form. On a sphere the projector of the paper is a scaling of the normal
velocity by 1 + e_n and of the slip by s, so that a law is just the pair (e_n, s)."""

from abc import abstractmethod
from typing import Any, ClassVar

import equinox as eqx

from .._math import Number, as_number, is_constant, minimum, plus, ratio, root, times, where


class AbstractContactLaw(eqx.Module):
    """What happens at an impact. With unit normal n, normal velocity u_n and slip u of the contact point,

    v+ = v - (1 + e_n) u_n n - s u        omega+ = omega + s / (alpha r) (n x u)
    """

    restitution: eqx.AbstractVar[Number]
    rolls: ClassVar[bool | None] = None
    """What a ball does after its last bounce: roll, perhaps after sliding (True), slide freely (False), or nothing that
    is modelled."""

    def reversal(self) -> Number | None:
        """The share e_t of its slip that an impact reverses if it grips; `None` where there is no such number."""
        return None

    def resistance(self) -> tuple[Any, Any]:
        """The coefficients of rolling resistance and of spinning friction of a ball that stays on the surface."""
        return 0.0, 0.0

    def sliding_friction(self) -> Number | None:
        """The coefficient f of a ball that slides on the surface after its last bounce; `None` where it cannot."""
        return None

    @abstractmethod
    def slip_factor(self, inertia_ratio: Number, closing_speed: Number, slip_squared: Number) -> Number:
        """The factor s that multiplies the slip.

        **Arguments:** `inertia_ratio` alpha; `closing_speed` |u_n| in m/s; `slip_squared` |u|^2 in m^2/s^2.
        """

    def admissible(self) -> list:
        """Conditions on the coefficients, each a pair (bool, sentence)."""
        e = self.restitution
        return [((e >= 0) & (e <= 1), f"`restitution` must lie in [0, 1], but got {e}; 1 conserves energy")]


def _reject_outside(law: AbstractContactLaw) -> None:
    """Raise for coefficients that are known now and out of range. Traced ones end as `RESULTS.invalid_state`."""
    for holds, sentence in law.admissible():
        if isinstance(holds, bool) and not holds:
            raise ValueError(f"Argument {sentence}.")


def _grip(inertia_ratio: Number) -> Number:
    """k = alpha / (1 + alpha): the share of the slip that a contact of infinite friction stops."""
    return inertia_ratio / (1 + inertia_ratio)


def _resists(law: "Rough | Frictional") -> list:
    found = (("rolling", law.rolling), ("spinning", law.spinning))
    return [(value >= 0, f"`{name}` must not be negative, but got {value}; 0 is without loss") for name, value in found]


def _within(name: str, value: Number, low: float, high: float, remedy: str):
    return ((value >= low) & (value <= high), f"`{name}` must lie in [{low:g}, {high:g}], but got {value}; {remedy}")


class Rough(AbstractContactLaw):
    """The law of the paper: no slip is possible at the contact (Theorem 5.2 and section 6).

    **Arguments:**

    - `restitution`: e_n in [0, 1], normal coefficient. 1 conserves energy, 0 is plastic.
    - `tangential`: e_t in [-1, 1], the share of the slip that is reversed. `None` means the paper's law, in which one
        coefficient mu multiplies the normal and the tangential part alike. -1 leaves the slip untouched.
    - `rolling`: coefficient c >= 0 of rolling resistance. A ball that rolls, pressed on with the force N, has a torque
        c (1 + alpha) N r against its rolling, so that on the level it slows down by c g and stops.
    - `spinning`: coefficient c >= 0 of spinning friction, for a ball that stays on the surface: a torque c N r against
        the spin about the normal, which on the level loses c g / (alpha r) a second.

    Raises `ValueError` for a coefficient out of range. Source: the paper, Theorem 5.2 and (6.1); for two coefficients
    Garwin, Am. J. Phys. 37, 88 (1969) and Cross, Am. J. Phys. 70, 1093 (2002).

    ```python
    from nonholo_jax import Rough
    superball = Rough(restitution=0.9, tangential=0.5)
    ```
    """

    restitution: Number = eqx.field(converter=as_number, default=1.0)
    tangential: Number | None = eqx.field(converter=as_number, default=None)
    rolling: Number = eqx.field(converter=as_number, default=0.0)
    spinning: Number = eqx.field(converter=as_number, default=0.0)
    rolls: ClassVar[bool | None] = True

    def __check_init__(self):
        _reject_outside(self)

    def reversal(self) -> Number:
        return self.restitution if self.tangential is None else self.tangential

    def admissible(self) -> list:
        checks = super().admissible()
        if self.tangential is not None:
            checks.append(_within("tangential", self.tangential, -1.0, 1.0, "1 reverses the slip, -1 keeps it"))
        return [*checks, *_resists(self)]

    def resistance(self) -> tuple[Any, Any]:
        return self.rolling, self.spinning

    def slip_factor(self, inertia_ratio: Number, closing_speed: Number, slip_squared: Number) -> Number:
        return times(1 + self.reversal(), _grip(inertia_ratio))


class Smooth(AbstractContactLaw):
    """A frictionless wall: the slip and the spin are untouched.

    **Arguments:** `restitution`: e_n in [0, 1]. Raises `ValueError` out of that range. Source: the paper, (6.1) with
    B of rank one.

    ```python
    from nonholo_jax import Smooth
    ice = Smooth(restitution=0.8)
    ```
    """

    restitution: Number = eqx.field(converter=as_number, default=1.0)
    rolls: ClassVar[bool | None] = False

    def __check_init__(self):
        _reject_outside(self)

    def reversal(self) -> Number:
        return -1.0

    def slip_factor(self, inertia_ratio: Number, closing_speed: Number, slip_squared: Number) -> Number:
        return 0.0


class Frictional(AbstractContactLaw):
    """A rough contact whose tangential impulse is capped by Coulomb friction: the ball grips where the rough law
    needs less than `friction` times the normal impulse, and slips throughout the impact where it needs more.

    **Arguments:**

    - `restitution`: e_n in [0, 1].
    - `tangential`: e_t in [-1, 1] of the gripping contact.
    - `friction`: Coulomb coefficient f >= 0.
    - `rolling`, `spinning`: as in `Rough`, of a ball that stays on the surface; while it slips, `rolling` does nothing.

    Raises `ValueError` out of range. Source: Walton's three-parameter law, as in Foerster et al., Phys. Fluids 6,
    1108 (1994). After the last bounce the ball slides, with the same coefficient, until it rolls.

    ```python
    from nonholo_jax import Frictional
    tennis = Frictional(restitution=0.75, tangential=0.1, friction=0.6)
    ```
    """

    restitution: Number = eqx.field(converter=as_number)
    tangential: Number = eqx.field(converter=as_number)
    friction: Number = eqx.field(converter=as_number)
    rolling: Number = eqx.field(converter=as_number, default=0.0)
    spinning: Number = eqx.field(converter=as_number, default=0.0)
    rolls: ClassVar[bool | None] = True

    def __check_init__(self):
        _reject_outside(self)

    def reversal(self) -> Number:
        return self.tangential

    def sliding_friction(self) -> Number:
        """0 for e_t = -1: then no impact of a train touches the slip, however slow."""
        if is_constant(self.tangential):
            return self.friction if self.tangential > -1 else 0.0
        return where(self.tangential > -1, self.friction, 0.0)

    def admissible(self) -> list:
        sentence = f"`friction` must not be negative, but got {self.friction}; 0 is a smooth wall"
        tangential = _within("tangential", self.tangential, -1.0, 1.0, "1 reverses the slip, -1 keeps it")
        return [*super().admissible(), tangential, (self.friction >= 0, sentence), *_resists(self)]

    def resistance(self) -> tuple[Any, Any]:
        return self.rolling, self.spinning

    def slip_factor(self, inertia_ratio: Number, closing_speed: Number, slip_squared: Number) -> Number:
        gripping = times(1 + self.tangential, _grip(inertia_ratio))
        if is_constant(gripping) and gripping == 0:
            return 0.0
        sliding = times(self.friction, times(plus(1.0, self.restitution), closing_speed))
        # Without slip both laws give the same impulse, zero; `otherwise` then keeps the gripping branch.
        return minimum(gripping, ratio(sliding, root(slip_squared), otherwise=gripping))
