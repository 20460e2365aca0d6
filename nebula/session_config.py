"""The numbers of a cloud-client session that no option sets, with their sources (session.yaml)."""

from __future__ import annotations

from dataclasses import dataclass

from arch.provenance import Provenance
from nebula.config import config_path, load_config


@dataclass(frozen=True, kw_only=True)
class ReuseWindow(Provenance):
    """w_r*: a node that was in no cut for longer is dropped by both ends."""

    frames: int

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_integers(0, "frames")


@dataclass(frozen=True, kw_only=True)
class DisplayRate(Provenance):
    """Frames per second of the head trace and of the session's clock."""

    hz: float

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_positive("hz")


@dataclass(frozen=True, kw_only=True)
class CloudTime(Provenance):
    """From the arrival of a pose at the cloud to the first byte of the answer."""

    compute_ms: float

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_not_negative("compute_ms")


@dataclass(frozen=True, kw_only=True)
class LodSearch(Provenance):
    """How the cloud searches: see `lod_cloud.make_search`."""

    method: str
    hysteresis: float

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_not_negative("hysteresis")


@dataclass(frozen=True, kw_only=True)
class CodebookSize(Provenance):
    """Vector quantisation of the spherical harmonics, by one codec."""

    words: int
    stages: int

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_integers(1, "words", "stages")


@dataclass(frozen=True)
class SessionConfig:
    """configs/session/session.yaml."""

    reuse_window: ReuseWindow
    display_rate: DisplayRate
    cloud: CloudTime
    search: LodSearch
    codebook: CodebookSize  # of the paper's codec
    compact_codebook: CodebookSize


def load_session_config() -> SessionConfig:
    """The shipped configs/session/session.yaml."""
    return load_config(SessionConfig, config_path("session", "session"), "session")
