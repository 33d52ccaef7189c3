"""Section 5.2: the DLS indicators along the damping, and where the gait is lost."""

import numpy as np

from vrw_jax.paper.facts import printed
from vrw_jax.paper.facts.base import DIGIT, SIGN, Evidence, Fact, near
from vrw_jax.paper.gaits import SETTLED
from vrw_jax.wheel import Outcome


def indicator_facts(e: Evidence) -> list[Fact]:
    group = "DLS indicators over c, slope 0.30 rad"
    branch = e.branch
    regular = branch.sel(damping=slice(1.0, 219.0))
    beyond = branch.sel(damping=slice(220.0, None))
    at = lambda c, name: float(branch[name].sel(damping=c))
    impulse = regular.lambda_I4.values
    both = np.array([printed.landing(e.params, x).impulse for x in regular.section_state.values])
    three = {
        c: [at(c, n) for n in ("lambda_I4", "lambda_2_plus", "lambda_4_plus")]
        for c in (50.0, 100.0, 200.0)
    }
    walks_on = bool((beyond.outcome == Outcome.STEPPED).all())
    return [
        Fact(
            group,
            "a period-1 gait stands at every whole c up to 219",
            "§5.2, Fig. 10",
            "1 … 219 (from 5 on with λ2⁺ ≥ 0)",
            f"{int(regular.settled.sum())} of {regular.sizes['damping']} settled",
            bool(regular.settled.all()),
            f"change per step below {SETTLED:g}",
        ),
        Fact(
            group,
            "λ4⁺ falls monotonically with c",
            "§5.2, Fig. 10(b)",
            "monotone",
            f"{at(1.0, 'lambda_4_plus'):.1f} … {at(219.0, 'lambda_4_plus'):.2f} N",
            bool((np.diff(regular.lambda_4_plus) < 0.0).all()),
            SIGN,
        ),
        Fact(
            group,
            "λ4⁺ is gone at c = 220",
            "§5.2, Fig. 10(b)",
            "0 at 220",
            f"{at(219.0, 'lambda_4_plus'):+.2f} N at 219, on the line through the last two "
            f"{2 * at(219.0, 'lambda_4_plus') - at(218.0, 'lambda_4_plus'):+.2f} N at 220",
            at(219.0, "lambda_4_plus")
            > 0.0
            > 2 * at(219.0, "lambda_4_plus") - at(218.0, "lambda_4_plus"),
            "a sign on the integer grid of c",
        ),
        Fact(
            group,
            "λ4⁺ at c = 219",
            "independent code",
            "+0.40 N",
            f"{at(219.0, 'lambda_4_plus'):+.3f} N",
            near(at(219.0, "lambda_4_plus"), 0.40, 5e-3),
            DIGIT,
        ),
        Fact(
            group,
            "λ2⁺ falls monotonically as c falls",
            "§5.2, Fig. 10(b)",
            "monotone",
            f"{at(219.0, 'lambda_2_plus'):.1f} … {at(1.0, 'lambda_2_plus'):.2f} N",
            bool((np.diff(regular.lambda_2_plus) > 0.0).all()),
            SIGN,
        ),
        Fact(
            group,
            "λ2⁺ is gone at c = 4",
            "§5.2, Fig. 10(b)",
            "0 at 4",
            f"{at(5.0, 'lambda_2_plus'):+.2f} N at 5, {at(4.0, 'lambda_2_plus'):+.2f} N at 4",
            at(5.0, "lambda_2_plus") > 0.0 >= at(4.0, "lambda_2_plus"),
            "a sign on the integer grid of c",
        ),
        Fact(
            group,
            "λ2⁺ at c = 5 and 4",
            "independent code",
            "+0.19, −0.36 N",
            f"{at(5.0, 'lambda_2_plus'):+.3f}, {at(4.0, 'lambda_2_plus'):+.3f} N",
            near(at(5.0, "lambda_2_plus"), 0.19, 5e-3)
            and near(at(4.0, "lambda_2_plus"), -0.36, 5e-3),
            DIGIT,
        ),
        Fact(
            group,
            "λ_I4 is always positive",
            "§5.2, Fig. 10(a)",
            "> 0",
            f"{impulse.min():.2f} … {impulse.max():.2f} N·s",
            bool((impulse > 0.0).all()),
            SIGN,
        ),
        Fact(
            group,
            "range of λ_I4",
            "independent code",
            "1.82 … 2.14 N·s",
            f"{impulse.min():.2f} … {impulse.max():.2f} N·s",
            near(impulse.min(), 1.82, 0.02) and near(impulse.max(), 2.14, 5e-3),
            "0.02 at the lower end, which depends on the least c (1.81 at 1, 1.84 at 5)",
        ),
        Fact(
            group,
            "λ_I2 > 0 always",
            "§5.1 (A2)",
            "> 0",
            f"{both[:, 1].min():.1f} … {both[:, 1].max():.1f} N·s",
            bool((both[:, 1] > 0.0).all()),
            SIGN,
        ),
        Fact(
            group,
            "all indicators are positive at c = 50, 100, 200",
            "§5.2",
            "> 0",
            "least of λ_I4, λ2⁺, λ4⁺: " + ", ".join(f"{min(v):.2f}" for v in three.values()),
            all(min(v) > 0.0 for v in three.values()),
            SIGN,
        ),
        Fact(
            group,
            "from c = 220 on it walks, but not with period 1",
            "§5.2",
            "stable, not 1-period",
            f"walks on: {'yes' if walks_on else 'no'}; change per step "
            f"{float(beyond.change.min()):.1g} or more, at c = 220 … "
            f"{float(beyond.damping.max()):.0f}",
            walks_on and not bool(beyond.settled.any()) and float(beyond.change.min()) > 1e-4,
            "1e-4: ten thousand times the change that counts as settled",
        ),
        Fact(
            group,
            "the loss is abrupt: DLS does not shrink to nothing as λ4⁺ → 0",
            "independent code",
            "53 %",
            f"{100 * at(219.0, 'dls_fraction'):.1f} % at c = 219",
            near(100 * at(219.0, "dls_fraction"), 53.0, 0.5),
            "half a per cent: published as a whole number",
        ),
        Fact(
            group,
            "at c = 200 the basin is small: a start with 2 rad/s falls out of the sequence",
            "independent code",
            "touchdown before Leg 2 is back",
            str(e.too_fast.outcome).lower().replace("_", " "),
            e.too_fast.outcome == Outcome.TOUCHDOWN_BEFORE_STOPPER.name,
            "an outcome",
        ),
    ]
