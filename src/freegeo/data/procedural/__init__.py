"""Rooms generated from integer seeds, with exact ground truth: training and test data of the embedded model."""

from __future__ import annotations

from freegeo.data.procedural.domains import DOMAINS, Domain, get_domain
from freegeo.data.procedural.photographs import photograph_room
from freegeo.data.procedural.raytrace import RenderedViews, intrinsics, render, resized_intrinsics
from freegeo.data.procedural.rooms import RoomBatch, sample_rooms
from freegeo.data.procedural.walks import Walk, walk

__all__ = [
    "DOMAINS",
    "Domain",
    "RenderedViews",
    "RoomBatch",
    "Walk",
    "get_domain",
    "intrinsics",
    "photograph_room",
    "render",
    "resized_intrinsics",
    "sample_rooms",
    "walk",
]
