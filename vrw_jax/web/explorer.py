"""Access to the page docs/wheel.html: its address, and a widget that shows it in a notebook."""

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
"""Names of the models that the page supports."""
HEIGHT = 900
"""Default height of the widget, in pixels."""

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
"""JavaScript of the widget: it shows the page in a frame and exchanges changed values with it."""


def page_path() -> Path:
    """Return the path of the page, inside an installed package or beside it."""
    package = Path(__file__).parents[1]
    return next(
        p for p in (package / "wheel.html", package.parent / "docs/wheel.html") if p.exists()
    )


def page_address(params: WheelParams, rung: str = RUNGS[0]) -> str:
    """Return the address of the page, opened at this wheel."""
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
    """Return an interactive widget of the wheel for Jupyter, JupyterLab, VS Code and marimo.

    It is the page docs/wheel.html, which computes in the browser with the step of this library. The
    property `params` of the widget is the wheel that is shown; setting it moves the sliders. The
    properties `friction` and `model_name` work likewise. `measures` holds the measures of the step
    by the names of `vrw.MEASURES`. The package anywidget is required:
    `pip install 'vrw-jax[explore]'`.

    Args:
        params: the wheel at the start; by default that of Table 1.
        friction: friction coefficient of the ground, for unilateral contact and for margins.
        model_name: "viscoelastic", "rigid" for legs without springs, or "unilateral" for unilateral
            contact.
        dataset: dataset of `vrw.scan` over a grid of two parameters, shown as a map.
        height: height of the widget, in pixels.

    Returns:
        The widget, to be shown in a cell of its own.

    Raises:
        TypeError, ValueError: if an argument is invalid; the message names the remedy.
        ImportError: if anywidget is not installed.

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
    """Return the class of the widget, created on first use because anywidget is optional."""
    try:
        import anywidget
        import traitlets
    except ImportError as error:
        raise ImportError(
            "vrw.explore needs anywidget, which is not installed: "
            "run pip install 'vrw-jax[explore]'."
        ) from error

    class Explorer(anywidget.AnyWidget):
        """Widget that shows the page in a frame and exchanges numbers with it."""

        _esm = FRAME
        page = traitlets.Unicode().tag(sync=True)
        values = traitlets.Dict().tag(sync=True)
        told = traitlets.Dict().tag(sync=True)
        map = traitlets.Dict().tag(sync=True)
        height = traitlets.Int(HEIGHT).tag(sync=True)

        @property
        def params(self) -> WheelParams:
            """Return the wheel that is shown."""
            numbers = {name: float(self.values[name]) for name in DOMAINS}
            return WheelParams(**numbers, n_legs=int(self.values["n_legs"]))

        @params.setter
        def params(self, params: WheelParams) -> None:
            self.values = _values(params, self.friction, self.rung)

        @property
        def friction(self) -> float:
            """Return the friction coefficient."""
            return float(self.values[FRICTION])

        @friction.setter
        def friction(self, value: float) -> None:
            self.values = {**self.values, FRICTION: known_friction(value)}

        @property
        def rung(self) -> str:
            """Return the name of the model."""
            return str(self.values["rung"])

        @rung.setter
        def rung(self, value: str) -> None:
            self.values = {**self.values, "rung": chosen("rung", value, RUNGS)}

    return Explorer


def _values(params: WheelParams, friction: float, rung: str) -> dict[str, float | str]:
    """Return the values that the page exchanges."""
    numbers = {name: float(getattr(params, name)) for name in DOMAINS}
    return {**numbers, FRICTION: friction, "n_legs": params.n_legs, "rung": rung}


def _map_of(dataset: "xr.Dataset") -> dict[str, Any]:
    """Return a scan over two parameters in the format of the page's map, with None for NaN."""
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
    """Return the values as nested lists, with None in place of a value that is not finite."""
    finite = lambda x: float(x) if math.isfinite(x) else None
    return [[finite(x) for x in row] for row in values.values.tolist()]
