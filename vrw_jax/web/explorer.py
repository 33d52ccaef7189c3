"""The page docs/wheel.html at hand: its address, and a widget whose wheel Python reads and sets."""

import functools
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlencode

from vrw_jax.wheel import DOMAINS, FRICTION, WheelParams, known_friction
from vrw_jax.wording import chosen, instance, untraced, whole

if TYPE_CHECKING:
    import xarray as xr

RUNGS = "viscoelastic", "rigid", "unilateral"
"""Of the ladder, those that the page walks on."""
HEIGHT = 900
"""Of the widget, in pixels of the screen."""

FRAME = """
function render({ model, el }) {
  const frame = document.createElement("iframe");
  frame.title = "A wheel that walks on springs";
  frame.style.cssText = `width: 100%; height: ${model.get("height")}px; border: 0`;
  frame.srcdoc = model.get("page");
  let told = "", ready = false; // what it says before it is ready is its own beginning
  const send = () => {
    const values = model.get("values");
    const news = { vrw: "set", values };
    if (JSON.stringify(values) !== told) frame.contentWindow.postMessage(news, "*");
  };
  const show = () =>
    frame.contentWindow.postMessage({ vrw: "map", given: model.get("map") }, "*");
  const hear = ({ source, data }) => {
    if (source !== frame.contentWindow || !data) return;
    if (data.vrw === "ready") {
      ready = true;
      show();
      send();
    } else if (data.vrw === "values" && ready) {
      told = JSON.stringify(data.values);
      model.set("values", data.values);
      model.set("told", data.told);
      model.save_changes();
    }
  };
  window.addEventListener("message", hear);
  model.on("change:values", send);
  model.on("change:map", show);
  el.appendChild(frame);
  return () => window.removeEventListener("message", hear);
}
export default { render };
"""
"""What a notebook's page does: it holds the wheel's page in a frame and passes on what changes."""


def page_path() -> Path:
    """The page's file: in an installed package inside it, else beside it."""
    package = Path(__file__).parents[1]
    return next(
        p for p in (package / "wheel.html", package.parent / "docs/wheel.html") if p.exists()
    )


def page_address(params: WheelParams, rung: str = RUNGS[0]) -> str:
    """Where a browser finds the page, opened at this wheel."""
    usual = _values(WheelParams(), 1.0, RUNGS[0])
    given = _values(params, 1.0, chosen("rung", rung, RUNGS))
    values = {name: value for name, value in given.items() if value != usual[name]}
    return page_path().as_uri() + (f"#{urlencode(values)}" if values else "")


def explore(
    params: WheelParams | None = None,
    *,
    friction: float = 1.0,
    rung: str = "viscoelastic",
    dataset: "xr.Dataset | None" = None,
    height: int = HEIGHT,
) -> Any:
    """The wheel to play with, as a widget of Jupyter, JupyterLab, VS Code and marimo.

    It is the page docs/wheel.html, which computes in the browser with this library's own step.
    The widget's `params` are the wheel that is shown: read them after moving a slider, set them to
    move it. `friction` and `rung` likewise; `told` holds what the page says of the step, by the
    names of `vrw.MEASURES`. Needs anywidget: `pip install 'vrw-jax[explore]'`.

    Args:
        params: that it begins with; Table 1's by default.
        friction: of real ground, and what margins refer to.
        rung: "viscoelastic", "rigid" for legs without springs, or "unilateral" for real ground.
        dataset: of a `vrw.scan` over a grid of two parameters: its map.
        height: of the widget, in pixels.

    Returns:
        The widget, to be shown in a cell of its own.

    Raises:
        TypeError, ValueError: an argument that can't be meant, in one sentence.
        ModuleNotFoundError: no anywidget.

    Examples:
        >>> wheel = vrw.explore(vrw.WheelParams(damping=150.0))
        >>> float(wheel.params.damping)
        150.0
    """
    params = WheelParams() if params is None else params
    instance("params", params, WheelParams, "write vrw.WheelParams(damping=..., slope=...)")
    untraced("vrw.explore", "it shows one known wheel", params)
    params.require_one("show one after the other")
    given = {} if dataset is None else _map_of(dataset)
    return _widget()(
        page=page_path().read_text(encoding="utf-8"),
        values=_values(params, known_friction(friction), chosen("rung", rung, RUNGS)),
        map=given,
        height=whole("height", height),
    )


@functools.cache
def _widget() -> type:
    """The widget's class, made when the first is asked for: few have anywidget."""
    try:
        import anywidget
        import traitlets
    except ImportError as error:
        raise ImportError(
            "vrw.explore needs anywidget, which is not installed: "
            "run pip install 'vrw-jax[explore]'."
        ) from error

    class Explorer(anywidget.AnyWidget):
        """The page in a frame, and its numbers in both directions."""

        _esm = FRAME
        page = traitlets.Unicode().tag(sync=True)
        values = traitlets.Dict().tag(sync=True)
        told = traitlets.Dict().tag(sync=True)
        map = traitlets.Dict().tag(sync=True)
        height = traitlets.Int(HEIGHT).tag(sync=True)

        @property
        def params(self) -> WheelParams:
            """The wheel that is shown."""
            numbers = {name: float(self.values[name]) for name in DOMAINS}
            return WheelParams(**numbers, n_legs=int(self.values["n_legs"]))

        @params.setter
        def params(self, params: WheelParams) -> None:
            self.values = _values(params, self.friction, self.rung)

        @property
        def friction(self) -> float:
            """The coefficient that margins refer to."""
            return float(self.values[FRICTION])

        @friction.setter
        def friction(self, value: float) -> None:
            self.values = {**self.values, FRICTION: known_friction(value)}

        @property
        def rung(self) -> str:
            """Of the model that walks."""
            return str(self.values["rung"])

        @rung.setter
        def rung(self, value: str) -> None:
            self.values = {**self.values, "rung": chosen("rung", value, RUNGS)}

    return Explorer


def _values(params: WheelParams, friction: float, rung: str) -> dict[str, float | str]:
    numbers = {name: float(getattr(params, name)) for name in DOMAINS}
    return {**numbers, FRICTION: friction, "n_legs": params.n_legs, "rung": rung}


def _map_of(dataset: "xr.Dataset") -> dict[str, Any]:
    """A scan over a grid of two parameters as the page's map takes it; None for no number."""
    import xarray

    instance("dataset", dataset, xarray.Dataset, "give a scan of vrw.grid over two parameters")
    axes = [str(name) for name in dataset.sizes if name in DOMAINS and dataset.sizes[name] > 1]
    if len(axes) != 2:
        raise ValueError(
            f"the dataset has the axes {', '.join(map(str, dataset.sizes))}, but a map has two "
            "parameters: give a scan of vrw.grid over two of them."
        )
    flat = dataset.isel({name: 0 for name in dataset.sizes if name in DOMAINS and name not in axes})
    measures: dict[str, Any] = {}
    for name, column in flat.data_vars.items():
        rest = [dim for dim in column.dims if dim not in axes]
        if column.dtype.kind == "f" and set(axes) <= set(column.dims):
            measures[str(name)] = _rows(column.min(rest).transpose(*axes[::-1]))
    return {
        "axes": [{"name": name, "values": flat[name].values.tolist()} for name in axes],
        "measures": measures,
        "outcome": flat["outcome"].transpose(*axes[::-1]).values.tolist(),
    }


def _rows(values: Any) -> list[list[float | None]]:
    finite = lambda x: float(x) if math.isfinite(x) else None
    return [[finite(x) for x in row] for row in values.values.tolist()]
