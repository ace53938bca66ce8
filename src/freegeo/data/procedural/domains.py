"""The domains of generated rooms: one literal table.

Source: docs/embedded-model.md, "How the rooms are made". Every domain owns a range of room seeds that no other domain
uses. A validation domain has its counterpart's appearance and texture bank and its own seeds, so that learning rates
and numbers of steps are never chosen on rooms that are scored. Rooms that are scored are photographed with one field of
view from the middle of the training range: at 64 pixels a small model does not learn to tell lenses apart, and wrong
intrinsics would limit every surface score. The domain `lens` keeps the range of fields of view, which measures that
limit. In `sparse` the camera moves and turns 1.5 times as far between photos: from one of the student's views (every
second photo) to the next it turns by 48 degrees on average instead of 32, with a field of view of 65.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from freegeo.errors import UserError

Range = tuple[float, float]


@dataclass(frozen=True)
class Domain:
    """One distribution of rooms and the seeds that belong to it."""

    name: str
    first_seed: int
    """The domain owns the seeds ``first_seed ... first_seed + seed_count - 1``."""
    seed_count: int
    room_count: int
    """How many rooms the benchmark scores (for training: how many the standard pool holds)."""
    bank: str = "train"
    """Name of the texture bank, see `freegeo.data.procedural.textures`."""
    half_extent_m: Range = (2.2, 3.5)
    """Half the width and half the depth of the room."""
    field_of_view_deg: Range = (58.0, 72.0)
    """Horizontal; one value per room."""
    pace: float = 1.0
    """Factor on how far the camera turns and moves from one view to the next."""
    ambient: Range = (0.4, 0.62)
    """Share of the light that does not come from the lamp."""
    exposure: float = 1.0
    """Factor on all light, like a longer exposure in a dim room, whose views would else be nearly black."""
    contrast: Range = (1.0, 1.0)
    """How far the second and third colour of a surface are from its first one: 0 makes the surface uniform."""
    saturation: float = 1.0
    colour_cast: float = 0.0
    """Largest relative loss of a colour channel."""
    gamma: Range = (1.0, 1.0)
    grain: float = 0.0
    """Standard deviation of the image noise, for RGB in [0, 1]."""

    def seeds(self, count: int | None = None, *, start: int = 0) -> range:
        """Seeds of `count` rooms (default: `room_count`), skipping the first `start` of the domain.

        Raises `UserError` when the domain does not own that many seeds.
        """
        count = self.room_count if count is None else count
        if start < 0 or count < 0 or start + count > self.seed_count:
            raise UserError(
                f"domain {self.name!r} owns {self.seed_count} room seeds, so rooms {start} to {start + count - 1} do "
                "not exist; ask for fewer rooms or an earlier start"
            )
        return range(self.first_seed + start, self.first_seed + start + count)


_TRAIN = Domain(name="train", first_seed=0, seed_count=10_000_000, room_count=10_000)
_TEST = Domain(name="test-id", first_seed=20_000_000, seed_count=10_000, room_count=200, field_of_view_deg=(65.0, 65.0))
_SHIFTED = (
    replace(_TEST, name="light", first_seed=20_100_000, room_count=100, bank="light", ambient=(0.12, 0.25),
            exposure=1.6, colour_cast=0.35, gamma=(1.3, 1.8), grain=0.04),
    replace(_TEST, name="lowtex", first_seed=20_200_000, room_count=100, bank="lowtex", contrast=(0.15, 0.3)),
    replace(_TEST, name="tex", first_seed=20_300_000, room_count=100, bank="tex", saturation=0.5),
    replace(_TEST, name="big", first_seed=20_400_000, room_count=100, bank="big", half_extent_m=(3.6, 5.5)),
    replace(_TEST, name="sparse", first_seed=20_600_000, room_count=100, bank="sparse", pace=1.5),
)  # fmt: skip
_VALIDATION_SHIFT = 10_000_000

DOMAINS: dict[str, Domain] = {domain.name: domain for domain in (_TRAIN, _TEST, *_SHIFTED)}
DOMAINS["lens"] = replace(
    _TEST, name="lens", first_seed=20_500_000, room_count=100, field_of_view_deg=_TRAIN.field_of_view_deg
)
DOMAINS["val-id"] = replace(_TEST, name="val-id", first_seed=_TEST.first_seed + _VALIDATION_SHIFT, room_count=100)
for _domain in _SHIFTED:
    DOMAINS[f"val-{_domain.name}"] = replace(
        _domain, name=f"val-{_domain.name}", first_seed=_domain.first_seed + _VALIDATION_SHIFT, room_count=60
    )


def get_domain(domain: str | Domain) -> Domain:
    """The domain of that name; a `Domain` is returned as it is. Raises `UserError` for an unknown name."""
    if isinstance(domain, Domain):
        return domain
    if domain not in DOMAINS:
        raise UserError(f"unknown room domain {domain!r}; choose one of {', '.join(DOMAINS)}")
    return DOMAINS[domain]
