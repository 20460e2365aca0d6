"""The link model."""

from __future__ import annotations

import pytest

from gaussians.errors import InputError
from lod_cloud.link import Link, Transmission


def test_one_message() -> None:
    link = Link(rate_mbps=100, latency_ms=5)
    assert link.transmission_s(1_250_000) == pytest.approx(0.1)
    assert link.energy_mj(1_000_000) == pytest.approx(100.0)  # 100 nJ/B
    assert Transmission(link).delivery_time_s(2.0, 125_000) == pytest.approx(2.0 + 0.01 + 0.005)


def test_a_message_waits_for_the_one_before() -> None:
    line = Transmission(Link(rate_mbps=8, latency_ms=0))  # one byte per microsecond
    assert line.delivery_time_s(0.0, 1_000_000) == pytest.approx(1.0)
    assert line.delivery_time_s(0.5, 1_000_000) == pytest.approx(2.0)
    assert line.delivery_time_s(5.0, 0) == pytest.approx(5.0)
    assert line.size_bytes == 2_000_000
    with pytest.raises(InputError, match="must be sent in order"):
        line.delivery_time_s(4.0, 1)


def test_bad_links() -> None:
    with pytest.raises(InputError, match="rate must be a positive number"):
        Link(rate_mbps=0)
    with pytest.raises(InputError, match="latency_ms must be a finite number >= 0"):
        Link(latency_ms=-1)
    with pytest.raises(InputError, match=">= 0 bytes"):
        Transmission(Link()).delivery_time_s(0.0, -1)


def test_bytes_between_two_searches() -> None:
    assert Link(rate_mbps=100).bytes_in(4 / 90) == 555_555
    assert Link(rate_mbps=0.001).bytes_in(1 / 90) == 1
