"""The register-transfer reference: which bits each hardware unit produces, clock by clock.

Empty so far. One module per unit of the accelerator will stand here, under the same stem as its
functional form in ``gaussians`` and its cycle model in ``arch.units``: ``projection_unit``,
``stereo_reprojection_unit``, ``stereo_buffer``, ``merge_unit``, ``rendering_unit``; and
``harness``, which feeds a unit and its cycle model the same words and compares them. It
implements the ``hw`` number formats. It may import ``arch`` and ``gaussians``; nothing below it
may import it.
"""
