"""Everything that distinguishes one published version of the adaptation loss from another."""

from dataclasses import dataclass
from typing import Literal

from freegeo.errors import UserError

IntraTokens = Literal["patches", "camera+patches", "all"]
CrossTokens = Literal["patches", "all"]
Selection = Literal["mixed", "topk", "random"]


@dataclass(frozen=True, kw_only=True)
class LossConfig:
    """The knobs of the adaptation loss; the named settings below are the only places that fill them in.

    Total = intra + sum_i angle_weights[i] * phi_i + weight_pk * kl_pk + weight_pq * kl_pq + weight_kq * kl_kq, where
    p is a reference token, q a query token of another kept view and k an anchor from a held-out view. A term of
    weight 0 is neither computed nor reported. Raises `UserError` for values that no version of the loss can have.
    """

    intra_tokens: IntraTokens
    """Tokens of the intra loss: patches, with the camera token (special token 0), or with every special token."""
    cross_tokens: CrossTokens
    """Tokens that references, queries and anchors are drawn from; in `all` special tokens come before patches."""
    weight_huber: float
    weight_cosine: float
    huber_delta: float
    """Where the classical Huber penalty of the intra loss turns from x^2/2 into delta (|x| - delta/2)."""
    angle_weights: tuple[float, float, float]
    """Weights of the angle terms at the reference, at the anchor and at the query."""
    angle_penalty: Literal["l1", "huber"]
    angle_huber_delta: float
    """Delta of the `huber` penalty on a difference of two cosines; not read by `l1`."""
    weight_pk: float
    weight_pq: float
    weight_kq: float
    kq_order: Literal["kq", "qk"]
    """Which of the two tokens is subtracted from the other: softmax((k - q)/tau) or softmax((q - k)/tau)."""
    pairing: Literal["all", "paired"]
    """Pairs of the distance terms: every reference with every query, or the i-th with the i-th query of each row."""
    distance_mode: Literal["kl", "huber"]
    """KL of the softmax distributions, or SmoothL1 between the difference vectors (`paired` only)."""
    distance_beta: float
    """Beta of SmoothL1 in distance mode `huber`; not read by `kl`."""
    outer: Literal["none", "smooth_l1"]
    """What each KL value goes through before the mean; not read by distance mode `huber`."""
    outer_beta: float
    temperature: float
    """tau of softmax((a - b)/tau), in units of the features."""
    num_reference: int
    num_query: int
    queries: Literal["pooled", "per_view"]
    """`num_query` tokens of all remaining kept views together, or the same `num_query` positions in each of them."""
    separate_draws: bool
    """Whether the angle terms and the distance terms draw their own tokens."""
    num_anchors: int
    selection: Selection
    """`mixed`: K//2 most similar, then K - K//2 least similar held-out tokens; `topk`; `random` with replacement."""
    reference_view: int
    """Position of the reference view among the student's views."""

    def __post_init__(self) -> None:
        positive = {
            name: getattr(self, name)
            for name in (
                *("huber_delta", "angle_huber_delta", "distance_beta", "outer_beta", "temperature"),
                *("num_reference", "num_query", "num_anchors"),
            )
        }
        for name, value in positive.items():
            if not value > 0:
                raise UserError(f"Loss setting {name} must be positive, not {value}; correct it in the recipe.")
        if self.distance_mode == "huber" and self.pairing == "all":
            raise UserError("Loss setting distance_mode 'huber' needs pairing 'paired'; change one of the two.")

    @property
    def uses_angles(self) -> bool:
        """Whether any angle term has a weight."""
        return any(self.angle_weights)

    @property
    def uses_distances(self) -> bool:
        """Whether any distance term has a weight."""
        return any((self.weight_pk, self.weight_pq, self.weight_kq))


def paper_loss(*, temperature: float) -> LossConfig:
    """The equations of the paper (arXiv 2604.14048), with its open points decided as in section 2 of the specs.

    temperature: 10 for the DA3 family, 1 for VGGT.
    """
    return LossConfig(
        intra_tokens="camera+patches",
        cross_tokens="patches",
        weight_huber=1.0,
        weight_cosine=1.0,
        huber_delta=1.0,
        angle_weights=(1.0, 1.0, 1.0),
        angle_penalty="l1",
        angle_huber_delta=1.0,
        weight_pk=1.0,
        weight_pq=1.0,
        weight_kq=1.0,
        kq_order="kq",
        pairing="all",
        distance_mode="kl",
        distance_beta=0.5,
        outer="none",
        outer_beta=0.5,
        temperature=temperature,
        num_reference=256,
        num_query=256,
        queries="pooled",
        separate_draws=False,
        num_anchors=4,
        selection="mixed",
        reference_view=0,
    )


def _released_loss(
    *, intra_tokens: IntraTokens, cross_tokens: CrossTokens, penalty: Literal["l1", "huber"], temperature: float
) -> LossConfig:
    return LossConfig(
        intra_tokens=intra_tokens,
        cross_tokens=cross_tokens,
        weight_huber=1.0,
        weight_cosine=2.0,
        huber_delta=1.0,
        angle_weights=(2.0, 2.0, 2.0),
        angle_penalty=penalty,
        angle_huber_delta=1.0,
        weight_pk=1.0,
        weight_pq=1.0,
        weight_kq=0.0,
        kq_order="qk",
        pairing="paired",
        distance_mode="kl",
        distance_beta=0.5,
        outer="smooth_l1",
        outer_beta=0.5,
        temperature=temperature,
        num_reference=256,
        num_query=256,
        queries="per_view",
        separate_draws=True,
        num_anchors=4,
        selection="mixed",
        reference_view=0,
    )


def released_da3_loss() -> LossConfig:
    """What the authors' DA3 runner computes (specs section 3.1): patch tokens only, L1 angles, temperature 10."""
    return _released_loss(intra_tokens="patches", cross_tokens="patches", penalty="l1", temperature=10.0)


def released_vggt_loss() -> LossConfig:
    """What the authors' VGGT runner computes (specs section 3.1): every token, Huber angles, temperature 1."""
    return _released_loss(intra_tokens="all", cross_tokens="all", penalty="huber", temperature=1.0)
