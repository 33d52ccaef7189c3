"""Section 5.2: the DLS indicators along the damping, and where the gait is lost."""

import numpy as np

from vrw_jax.paper.facts import printed
from vrw_jax.paper.facts.base import CODE, SIGN, Claim, Evidence, Group, Numbers, near
from vrw_jax.paper.gaits import SETTLED
from vrw_jax.wheel import Outcome


def _along_damping(e: Evidence) -> Numbers:
    branch = e.branch
    regular = branch.sel(damping=slice(1.0, 219.0))
    beyond = branch.sel(damping=slice(220.0, None))
    at = lambda c, name: float(branch[name].sel(damping=c))
    impulse = regular.lambda_I4.values
    both = np.array([printed.landing(e.params, x).impulse for x in regular.section_state.values])
    rear = {c: at(c, "lambda_4_plus") for c in (1.0, 218.0, 219.0)}
    walks_on = bool((beyond.outcome == Outcome.STEPPED).all())
    return {
        "n_settled": int(regular.settled.sum()),
        "n": regular.sizes["damping"],
        "rear": (rear[1.0], rear[219.0], 2 * rear[219.0] - rear[218.0]),
        "last_rear": rear[219.0],
        "rear_falls": bool((np.diff(regular.lambda_4_plus) < 0.0).all()),
        "fore": (at(219.0, "lambda_2_plus"), at(1.0, "lambda_2_plus")),
        "fore_5": at(5.0, "lambda_2_plus"),
        "fore_4": at(4.0, "lambda_2_plus"),
        "fore_grows": bool((np.diff(regular.lambda_2_plus) > 0.0).all()),
        "least": impulse.min(),
        "most": impulse.max(),
        "fore_impulse": (both[:, 1].min(), both[:, 1].max()),
        "smallest": [
            min(at(c, name) for name in ("lambda_I4", "lambda_2_plus", "lambda_4_plus"))
            for c in (50.0, 100.0, 200.0)
        ],
        "walks_on": walks_on,
        "yes_or_no": "yes" if walks_on else "no",
        "never_settles": not bool(beyond.settled.any()),
        "change": float(beyond.change.min()),
        "end": float(beyond.damping.max()),
        "share": 100 * at(219.0, "dls_fraction"),
        "too_fast": e.too_fast.outcome,
        "too_fast_ends": str(e.too_fast.outcome).lower().replace("_", " "),
    }


# fmt: off
INDICATORS = Group("DLS indicators over c, slope 0.30 rad", _along_damping, (
    Claim("a period-1 gait stands at every whole c up to 219", "§5.2, Fig. 10",
          "1 … 219 (from 5 on with λ2⁺ ≥ 0)", "{n_settled} of {n} settled",
          lambda n: n.n_settled == n.n, f"change per step below {SETTLED:g}"),
    Claim("λ4⁺ falls monotonically with c", "§5.2, Fig. 10(b)", "monotone",
          "{rear[0]:.1f} … {rear[1]:.2f} N", lambda n: n.rear_falls, SIGN),
    Claim("λ4⁺ is gone at c = 220", "§5.2, Fig. 10(b)", "0 at 220",
          "{rear[1]:+.2f} N at 219, on the line through the last two {rear[2]:+.2f} N at 220",
          lambda n: n.rear[1] > 0.0 > n.rear[2], "a sign on the integer grid of c"),
    Claim("λ4⁺ at c = 219", CODE, "+0.40 N", "{last_rear:+.3f} N", near(last_rear=(0.40, 5e-3))),
    Claim("λ2⁺ falls monotonically as c falls", "§5.2, Fig. 10(b)", "monotone",
          "{fore[0]:.1f} … {fore[1]:.2f} N", lambda n: n.fore_grows, SIGN),
    Claim("λ2⁺ is gone at c = 4", "§5.2, Fig. 10(b)", "0 at 4",
          "{fore_5:+.2f} N at 5, {fore_4:+.2f} N at 4",
          lambda n: n.fore_5 > 0.0 >= n.fore_4, "a sign on the integer grid of c"),
    Claim("λ2⁺ at c = 5 and 4", CODE, "+0.19, −0.36 N", "{fore_5:+.3f}, {fore_4:+.3f} N",
          near(fore_5=(0.19, 5e-3), fore_4=(-0.36, 5e-3))),
    Claim("λ_I4 is always positive", "§5.2, Fig. 10(a)", "> 0",
          "{least:.2f} … {most:.2f} N·s", lambda n: n.least > 0.0, SIGN),
    Claim("range of λ_I4", CODE, "1.82 … 2.14 N·s", "{least:.2f} … {most:.2f} N·s",
          near(least=(1.82, 0.02), most=(2.14, 5e-3)),
          "0.02 at the lower end, which depends on the least c (1.81 at 1, 1.84 at 5)"),
    Claim("λ_I2 > 0 always", "§5.1 (A2)", "> 0",
          "{fore_impulse[0]:.1f} … {fore_impulse[1]:.1f} N·s",
          lambda n: n.fore_impulse[0] > 0.0, SIGN),
    Claim("all indicators are positive at c = 50, 100, 200", "§5.2", "> 0",
          "least of λ_I4, λ2⁺, λ4⁺: {smallest[0]:.2f}, {smallest[1]:.2f}, {smallest[2]:.2f}",
          lambda n: min(n.smallest) > 0.0, SIGN),
    Claim("from c = 220 on it walks, but not with period 1", "§5.2", "stable, not 1-period",
          "walks on: {yes_or_no}; change per step {change:.1g} or more, at c = 220 … {end:.0f}",
          lambda n: n.walks_on and n.never_settles and n.change > 1e-4,
          "1e-4: ten thousand times the change that counts as settled"),
    Claim("the loss is abrupt: DLS does not shrink to nothing as λ4⁺ → 0", CODE, "53 %",
          "{share:.1f} % at c = 219", near(share=(53.0, 0.5)),
          "half a per cent: published as a whole number"),
    Claim("at c = 200 the basin is small: a start with 2 rad/s falls out of the sequence", CODE,
          "touchdown before Leg 2 is back", "{too_fast_ends}",
          lambda n: n.too_fast == Outcome.TOUCHDOWN_BEFORE_STOPPER.name, "an outcome"),
))
# fmt: on
