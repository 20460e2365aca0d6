"""Seeded synthetic scenes: a city to walk through, and benchmark views with known statistics."""

from gaussians.synthetic.city import City, generate_city
from gaussians.synthetic.views import BenchmarkView, benchmark_scene

__all__ = ["BenchmarkView", "City", "benchmark_scene", "generate_city"]
