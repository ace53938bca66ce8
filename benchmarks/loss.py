"""CPU seconds of the loss terms, forward and backward: the plain definition against products of matrices.

Run: python benchmarks/loss.py [--channels 384 1024 3072]

256 references, 256 queries in each of 3 views, 4 anchors, batch 1, one thread, random features. The plain angle loss
(`plain.py`) is timed on a sixteenth of the triplets and multiplied by sixteen; both versions are compared on that
sixteenth. Medians of 3 runs of the matrix form, 1 run of the plain one.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

import torch
from plain import angle_loss as plain_angle_loss
from record import write_result

from freegeo.adaptation.losses.angles import angle_loss
from freegeo.adaptation.losses.divergence import all_pairs_divergence
from freegeo.adaptation.losses.intra import intra_loss

REFERENCES, QUERIES, ANCHORS, PART = 256, 768, 4, 16


def timed(run: Callable[[], torch.Tensor], inputs: list[torch.Tensor], repeats: int = 1):
    """Median CPU seconds of value and gradient, the value, and the gradients of the inputs."""
    seconds = []
    for _ in range(repeats):
        for tensor in inputs:
            tensor.grad = None
        started = time.process_time()
        value = run()
        value.backward()
        seconds.append(time.process_time() - started)
    return median(seconds), float(value.detach()), [tensor.grad.clone() for tensor in inputs]


def measure(channels: int) -> dict:
    """All numbers for one feature width."""
    generator = torch.Generator().manual_seed(channels)
    tp, tq, k = (torch.randn(n, channels, generator=generator) for n in (REFERENCES, QUERIES, REFERENCES * ANCHORS))
    k = k.view(REFERENCES, ANCHORS, channels)
    p, q = ((t + 0.1 * torch.randn(t.shape, generator=generator)).requires_grad_() for t in (tp, tq))

    def matrix(references: int, queries: int):
        pair = (p[None, :references], q[None, :queries]), (tp[None, :references], tq[None, :queries])
        options = {"weights": (1.0, 1.0, 1.0), "penalty": "l1", "huber_delta": 1.0}
        return angle_loss(*pair, k[None, :references], **options)[0]

    few_p, few_q = REFERENCES // 4, QUERIES // 4
    plain_s, plain_value, plain_grad = timed(
        lambda: plain_angle_loss(p[:few_p], q[:few_q], tp[:few_p], tq[:few_q], k[:few_p]).sum(), [p, q]
    )
    _, part_value, part_grad = timed(lambda: matrix(few_p, few_q), [p, q])
    full_s, _, _ = timed(lambda: matrix(REFERENCES, QUERIES), [p, q], 3)
    kl_s, _, _ = timed(
        lambda: all_pairs_divergence((p[None], q[None]), (tp[None], tq[None]), temperature=10.0, form=None).mean(),
        [p, q],
        3,
    )
    tokens = torch.randn(1, 4, 256, channels, generator=generator)
    student = (tokens + 0.1).requires_grad_()
    intra_s, _, _ = timed(
        lambda: intra_loss([(student, tokens)], weight_huber=1.0, weight_cosine=2.0, huber_delta=1.0)[0], [student], 3
    )
    gradient = max(float((a - b).norm() / b.norm()) for a, b in zip(part_grad, plain_grad, strict=True))
    return {
        "angles_plain_s": plain_s * PART,
        "angles_matrix_s": full_s,
        "angles_faster": plain_s * PART / full_s,
        "value_difference": abs(part_value - plain_value) / plain_value,
        "gradient_difference": gradient,
        "kl_all_pairs_s": kl_s,
        "intra_1024_tokens_s": intra_s,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--channels", type=int, nargs="+", default=[384, 1024, 3072])
    parser.add_argument("--out", type=Path, default=Path(__file__).parent / "results" / "loss.json")
    options = parser.parse_args()
    torch.set_num_threads(1)
    results = {str(channels): measure(channels) for channels in options.channels}
    settings = {
        "references": REFERENCES, "queries": QUERIES, "anchors": ANCHORS, "plain_part": f"1/{PART}", "threads": 1,
        "command": "python benchmarks/loss.py",
    }  # fmt: skip
    write_result(options.out, settings=settings, results=results)
    write_table(options.out.with_suffix(".md"), results)


def write_table(path: Path, results: dict) -> None:
    """Write the numbers as a markdown table."""
    lines = [
        "# Losses, forward and backward, CPU seconds; angles of 256 x 768 x 4 triplets",
        "",
        "| C | plain | matrix form | faster | value differs | gradient differs | KL, all pairs | intra, 1024 tokens |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for channels, r in results.items():
        lines.append(
            f"| {channels} | {r['angles_plain_s']:.1f} | {r['angles_matrix_s']:.3f} | {r['angles_faster']:.0f} x "
            f"| {r['value_difference']:.1e} | {r['gradient_difference']:.1e} | {r['kl_all_pairs_s']:.3f} "
            f"| {r['intra_1024_tokens_s']:.4f} |"
        )
    path.write_text("\n".join([*lines, ""]), encoding="utf-8")


if __name__ == "__main__":
    main()
