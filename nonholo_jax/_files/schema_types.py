"""What the tables of a scene file are made of."""

import math
from typing import Annotated

from pydantic import AfterValidator, BaseModel, ConfigDict, Field
from pydantic_core import PydanticCustomError

SCHEMA = 1


class SceneError(ValueError):
    """A scene file cannot be used; the message is one line that names file, field, value and remedy."""


def fault(requirement: str, remedy: str, field: str = "") -> PydanticCustomError:
    """A fault that pydantic has no words for. `field` is relative to the table that was validated."""
    return PydanticCustomError("fault", "{requirement}", {"requirement": requirement, "remedy": remedy, "field": field})


def _directed(vector: list[float]) -> list[float]:
    length = math.hypot(*vector)
    if length == 0:
        raise fault("must not be the zero vector", "give it any length but zero")
    if not 1e-100 < length < 1e100:
        raise fault("must have a length between 1e-100 and 1e100", "only its direction counts, so use length 1")
    return vector


def _ordered(pair: list[float]) -> list[float]:
    if not pair[0] < pair[1]:
        raise fault("must be [low, high] with low < high", "exchange or move the two")
    return pair


Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Vector2 = Annotated[list[Positive], Field(min_length=2, max_length=2)]
Vector3 = Annotated[list[Finite], Field(min_length=3, max_length=3)]
Lengths3 = Annotated[list[Positive], Field(min_length=3, max_length=3)]
Direction = Annotated[Vector3, AfterValidator(_directed)]
Quaternion = Annotated[list[Finite], Field(min_length=4, max_length=4), AfterValidator(_directed)]
Restitution = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
Tangential = Annotated[float, Field(ge=-1, le=1, allow_inf_nan=False)]
Bounds = Annotated[list[float], Field(min_length=2, max_length=2), AfterValidator(_ordered)]
Name = Annotated[str, Field(pattern=r"^[\w-]+$")]


class Table(BaseModel):
    model_config = ConfigDict(strict=True, extra="forbid", frozen=True)
