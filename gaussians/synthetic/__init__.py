"""Seeded synthetic scenes: a city to walk through, benchmark views with known statistics, and
hostile cases for stereo methods."""

from gaussians.synthetic.city import City, generate_city
from gaussians.synthetic.city_tiles import DENSITIES, TiledCity
from gaussians.synthetic.hostile import HOSTILE, HostileCase
from gaussians.synthetic.views import BenchmarkView, benchmark_scene

__all__ = [
    "DENSITIES",
    "HOSTILE",
    "BenchmarkView",
    "City",
    "HostileCase",
    "TiledCity",
    "benchmark_scene",
    "generate_city",
]
