"""Mathematics without a ball: triples of scalars, sharing, polynomials, bounds, rotations, tiles, tangents, words."""

from .gap import bend_of as bend_of, gradient_of as gradient_of, reach_of as reach_of, value_of as value_of
from .hops import (
    ENDS as ENDS,
    FULL as FULL,
    PAUSES as PAUSES,
    Block as Block,
    Hopper as Hopper,
    Wall as Wall,
    hop as hop,
    hop_again as hop_again,
)
from .polynomial import (
    Interval as Interval,
    Polynomial as Polynomial,
    Window as Window,
    derivative as derivative,
    evaluate as evaluate,
    product as product,
    recentred as recentred,
    square as square,
)
from .rotation import matrix as matrix, rolled as rolled, turned as turned
from .shared import shared as shared
from .tangents import Iteration as Iteration, tangent_of as tangent_of
from .tiles import (
    LEAST_EFFORT as LEAST_EFFORT,
    along as along,
    by_tiles as by_tiles,
    free_devices as free_devices,
    in_tiles as in_tiles,
    on_cpu as on_cpu,
    over_devices as over_devices,
    unless_batched as unless_batched,
    where_needed as where_needed,
)
from .types import (
    KINDS as KINDS,
    NAMES_OF_RESULTS as NAMES_OF_RESULTS,
    NO_FAILURES as NO_FAILURES,
    NO_IMPACTS as NO_IMPACTS,
    RESULTS as RESULTS,
    Index as Index,
    Number as Number,
    Scalar as Scalar,
    Vector as Vector,
    Vector3 as Vector3,
    is_failure as is_failure,
    is_success as is_success,
    kind_name as kind_name,
    result_message as result_message,
    result_name as result_name,
    surfaces_hit as surfaces_hit,
)
from .vector import (
    Choice as Choice,
    add as add,
    as_number as as_number,
    as_pair as as_pair,
    as_quaternion as as_quaternion,
    as_vector as as_vector,
    beyond as beyond,
    components as components,
    cross as cross,
    dot as dot,
    frozen as frozen,
    is_constant as is_constant,
    maximum as maximum,
    minimum as minimum,
    norm as norm,
    pack as pack,
    plus as plus,
    ratio as ratio,
    root as root,
    scale as scale,
    slope as slope,
    subtract as subtract,
    times as times,
    total as total,
    unit as unit,
    where as where,
    where_vector as where_vector,
)
