"""What a solver of a moving base tells whoever knows more of its baseline."""

from rtkmesh_schemas.wire import Wire


class CandidatesMessage(Wire, frozen=True, kw_only=True):
    """The best integer vectors of one epoch and the baseline under each: m candidates of p ambiguities.

    ``satellite``, ``signal`` (rover's) and ``base_signal``: one each per ambiguity. ``integers``: single differences (cycles), m rows of p;
    of each system and pair of signals that of the reference is 0, so only differences within these mean something. ``count``: number of
    double differences. ``baselines_ecef_m``: rover minus base, m rows of 3, ECEF; ``covariance_ecef_m2``: the same for all, row-major
    3x3. ``norms``: m squared norms against the float ambiguities; ``beyond``: the least squared norm of what is not here.
    ``base_ecef_m``: where the base is; ``age_s``: rover minus base epoch; ``rover`` and ``base`` are the streams.
    """

    source: str
    start_id: str
    sequence: int
    week: int
    tow_s: float
    rover: str
    base: str
    satellite: list[str]
    signal: list[str]
    base_signal: list[str]
    count: int
    integers: list[int]
    baselines_ecef_m: list[float]
    covariance_ecef_m2: tuple[float, ...]
    norms: list[float]
    beyond: float
    base_ecef_m: tuple[float, float, float]
    age_s: float = 0.0
    received_mono_ns: int = 0
    published_mono_ns: int = 0
