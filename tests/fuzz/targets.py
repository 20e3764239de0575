"""The one table of fuzz targets."""

from tests.fuzz import document_targets, frame_targets, ingest_target
from tests.fuzz.harness import Target


def all_targets() -> list[Target]:
    """Return all targets; their shares make one whole run."""
    return [*frame_targets.targets(), *ingest_target.targets(), *document_targets.targets()]
