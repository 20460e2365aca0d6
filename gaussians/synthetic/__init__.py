"""Seeded synthetic scenes: a city to walk through, and benchmark views with known statistics."""

from gaussians.synthetic.city import City, generate_city

__all__ = ["City", "generate_city"]
