"""The `[monte_carlo]` table of a scene file."""

from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, model_validator

from .schema_types import Finite, Name, NotNegative, Positive, Table, Vector3, fault


def _listed(x: Any) -> Any:
    """One number stands for a list of it."""
    return [x] if isinstance(x, float | int) and not isinstance(x, bool) else x


Numbers = Annotated[list[Finite], BeforeValidator(_listed), Field(min_length=1)]
Spread = Annotated[list[NotNegative], BeforeValidator(_listed), Field(min_length=1)]
Names = Annotated[list[str], Field(min_length=1)]
Count = Annotated[int, Field(ge=1, le=1_000_000)]


class NormalTable(Table):
    kind: Literal["normal"]
    names: Names
    std: Spread
    mean: Numbers | None = None


class UniformTable(Table):
    kind: Literal["uniform"]
    names: Names
    low: Numbers
    high: Numbers


class LogNormalTable(Table):
    kind: Literal["lognormal"]
    names: Names
    sigma: Spread
    median: Numbers | None = None


class TruncatedNormalTable(Table):
    kind: Literal["truncated_normal"]
    names: Names
    std: Spread
    low: Numbers
    high: Numbers
    mean: Numbers | None = None


class CorrelatedTable(Table):
    kind: Literal["correlated"]
    names: Names
    covariance: Annotated[list[list[Finite]], Field(min_length=1)]
    mean: Numbers | None = None


class MeasuredTable(Table):
    kind: Literal["measured"]
    names: Names
    file: str
    columns: Names


VaryTable = Annotated[
    NormalTable | UniformTable | LogNormalTable | TruncatedNormalTable | CorrelatedTable | MeasuredTable,
    Field(discriminator="kind"),
]


class LandingTable(Table):
    kind: Literal["landing"]
    name: Name
    surface: str | None = None
    count: Count = 1


class LandingTimeTable(Table):
    kind: Literal["landing_time"]
    name: Name
    surface: str | None = None
    count: Count = 1


class ImpactCountTable(Table):
    kind: Literal["impact_count"]
    name: Name


class FinalPositionTable(Table):
    kind: Literal["final_position"]
    name: Name


class DistanceTable(Table):
    kind: Literal["distance"]
    name: Name
    point: Vector3
    after: Annotated[int, Field(ge=0, le=1_000_000)] = 1


class ReturnsTable(Table):
    kind: Literal["returns"]
    name: Name
    point: Vector3
    within: Positive
    after: Annotated[int, Field(ge=0, le=1_000_000)] = 1


MeasureTable = Annotated[
    LandingTable | LandingTimeTable | ImpactCountTable | FinalPositionTable | DistanceTable | ReturnsTable,
    Field(discriminator="kind"),
]


class MonteCarloTable(Table):
    vary: Annotated[list[VaryTable], Field(min_length=1)]
    measure: list[MeasureTable] = []
    n: Annotated[int, Field(ge=1, le=10**15)] = 100_000
    seed: Annotated[int, Field(ge=0, le=2**32 - 1)] = 0
    sequence: Literal["random", "sobol", "saltelli"] = "random"
    itinerary_length: Annotated[int, Field(ge=0, le=10_000)] = 8

    @model_validator(mode="after")
    def _names_differ(self):
        names = [each.name for each in self.measure]
        for i, name in enumerate(names):
            if name in names[:i]:
                raise fault("must have names that differ", f"rename the second {name!r}", "measure")
        return self


VARY = {"normal": NormalTable, "uniform": UniformTable, "lognormal": LogNormalTable,
        "truncated_normal": TruncatedNormalTable, "correlated": CorrelatedTable, "measured": MeasuredTable}  # fmt: skip
MEASURES = {"landing": LandingTable, "landing_time": LandingTimeTable, "impact_count": ImpactCountTable,
            "final_position": FinalPositionTable, "distance": DistanceTable, "returns": ReturnsTable}  # fmt: skip
