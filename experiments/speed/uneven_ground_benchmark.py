"""Compare the time of a step on uneven ground and on flat ground, in batches of both models.

    python -m experiments.speed.uneven_ground_benchmark [--repeats 11] [--sd 0.002]

Wheels near their gaits walk ten steps on flat ground and on lines whose slopes vary from foothold
to foothold, with the standard deviation `--sd`, rad. Both kinds of ground take turns in one
process. Times are CPU times, and medians over the repeats. The command writes a table into
`docs/benchmarks/steps.md`.
"""

import statistics
import time

import numpy as np

import vrw_jax as vrw
from experiments.shared.command import make_parser, parse_and_start_jax
from experiments.shared.tables import DOCS, describe_run, format_markdown, replace_block

N_STEPS, N_TRANSIENT_STEPS = 10, 20
N_PAPER_WHEELS, N_CONTACT_WHEELS = 4096, 1024
"""Numbers of wheels with the paper's model and with unilateral contact."""


def measure_rates(
    model: vrw.AbstractWheel | None, n_wheels: int, slope_sd: float, repeats: int
) -> tuple[float, float]:
    """Return gait steps per CPU second on flat and on uneven ground."""
    random = np.random.default_rng(1)
    parameters = {
        "damping": random.uniform(180.0, 215.0, n_wheels),
        "stiffness": random.uniform(480.0, 520.0, n_wheels),
    }
    slopes = 0.30 + slope_sd * random.standard_normal((n_wheels, N_STEPS + 1))
    grounds = [vrw.WheelParams(**parameters, slope=slope) for slope in (0.30, slopes)]
    states = np.tile(vrw.paper_start(), (n_wheels, 1))
    near_gait = vrw.step_batch(grounds[0], states, N_TRANSIENT_STEPS, model=model).section_state

    def measure_rate(params: vrw.WheelParams) -> float:
        began = time.process_time()
        walks = vrw.step_batch(params, near_gait, N_STEPS, model=model)
        return float(walks.n_stepped.sum()) / (time.process_time() - began)

    for params in grounds:
        measure_rate(params)  # compiles
    rates = [[measure_rate(params) for params in grounds] for _ in range(repeats)]
    flat, uneven = map(statistics.median, zip(*rates, strict=True))
    return flat, uneven


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--repeats", type=int, default=11)
    parser.add_argument("--sd", type=float, default=0.002)
    chosen = parse_and_start_jax(parser)
    cases: tuple[tuple[str, vrw.AbstractWheel | None, int], ...] = (
        ("paper's", None, N_PAPER_WHEELS),
        ("unilateral contact", vrw.UnilateralWheel(friction=0.7), N_CONTACT_WHEELS),
    )
    table = []
    for name, model, n_wheels in cases:
        flat, uneven = measure_rates(model, n_wheels, chosen.sd, chosen.repeats)
        table.append((name, f"{flat:,.0f}", f"{uneven:,.0f}", f"{uneven / flat:.2f}"))
    text = format_markdown(("model", "flat ground", "uneven ground", "ratio"), table)
    source = describe_run("experiments.speed.uneven_ground_benchmark")
    replace_block(DOCS / "benchmarks" / "steps.md", "uneven", text, source)
    print(text)


if __name__ == "__main__":
    main()
