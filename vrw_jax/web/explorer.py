"""Access to the page docs/wheel.html: its address, and a widget that shows it in a notebook."""

import functools
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlencode

from vrw_jax.selection import list_config_names
from vrw_jax.validation import (
    check_choice,
    check_int,
    check_not_traced,
    check_type,
    raise_for_renamed_arguments,
)
from vrw_jax.wheel import FRICTION_NAME, PARAMETER_DOMAINS, WheelParams, require_known_friction

if TYPE_CHECKING:
    import xarray as xr

PAGE_MODEL_NAMES = list_config_names("explore")
"""Names of the models that the page supports."""

WIDGET_JAVASCRIPT = """
function render({ model, el }) {
  const frame = document.createElement("iframe");
  frame.title = "A wheel that walks on springs";
  frame.style.cssText = `width: 100%; height: ${model.get("height")}px; border: 0`;
  frame.srcdoc = model.get("page");
  // The page sends its default values before it is ready; these are ignored.
  let valuesOfPage = "", ready = false;
  const sendValues = () => {
    const values = model.get("values");
    if (JSON.stringify(values) !== valuesOfPage)
      frame.contentWindow.postMessage({ vrw: "set", values }, "*");
  };
  const sendMap = () =>
    frame.contentWindow.postMessage({ vrw: "map", given: model.get("map") }, "*");
  const receive = ({ source, data }) => {
    if (source !== frame.contentWindow || !data) return;
    if (data.vrw === "ready") {
      ready = true;
      sendMap();
      sendValues();
    } else if (data.vrw === "values" && ready) {
      valuesOfPage = JSON.stringify(data.values);
      model.set("values", data.values);
      model.set("measures", data.measures);
      model.save_changes();
    }
  };
  window.addEventListener("message", receive);
  model.on("change:values", sendValues);
  model.on("change:map", sendMap);
  el.appendChild(frame);
  return () => window.removeEventListener("message", receive);
}
export default { render };
"""
"""JavaScript of the widget, which shows the page in a frame and exchanges changed values with
it.
"""


def find_page() -> Path:
    """Return the path of the page, inside an installed package or beside it."""
    package = Path(__file__).parents[1]
    return next(
        candidate_path
        for candidate_path in (package / "wheel.html", package.parent / "docs/wheel.html")
        if candidate_path.exists()
    )


def make_page_address(params: WheelParams, model_name: str = PAGE_MODEL_NAMES[0]) -> str:
    """Return the address of the page, opened with this wheel."""
    default_values = _page_values(WheelParams(), 1.0, PAGE_MODEL_NAMES[0])
    page_values = _page_values(
        params, 1.0, check_choice("model_name", model_name, PAGE_MODEL_NAMES)
    )
    values = {name: value for name, value in page_values.items() if value != default_values[name]}
    return find_page().as_uri() + (f"#{urlencode(values)}" if values else "")


@raise_for_renamed_arguments(rung="model_name")
def explore(
    params: WheelParams | None = None,
    *,
    friction: float = 1.0,
    model_name: str = "viscoelastic",
    dataset: "xr.Dataset | None" = None,
    height: int = 900,
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
    check_type("params", params, WheelParams, "write vrw.WheelParams(damping=..., slope=...)")
    check_not_traced("vrw.explore", "it shows one known wheel", params)
    params.require_single("show one after the other")
    map_data = {} if dataset is None else _make_map(dataset)
    return _make_widget_class()(
        page=find_page().read_text(encoding="utf-8"),
        values=_page_values(
            params,
            require_known_friction(friction),
            check_choice("model_name", model_name, PAGE_MODEL_NAMES),
        ),
        map=map_data,
        height=check_int("height", height),
    )


@functools.cache
def _make_widget_class() -> type:
    """Return the class of the widget, which is created on first use because anywidget is
    optional.
    """
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

        _esm = WIDGET_JAVASCRIPT
        page = traitlets.Unicode().tag(sync=True)
        values = traitlets.Dict().tag(sync=True)
        measures = traitlets.Dict().tag(sync=True)
        map = traitlets.Dict().tag(sync=True)
        height = traitlets.Int().tag(sync=True)

        @property
        def params(self) -> WheelParams:
            """Return the wheel that is shown."""
            numbers = {name: float(self.values[name]) for name in PARAMETER_DOMAINS}
            return WheelParams(**numbers, n_legs=int(self.values["n_legs"]))

        @params.setter
        def params(self, params: WheelParams) -> None:
            self.values = _page_values(params, self.friction, self.model_name)

        @property
        def friction(self) -> float:
            """Return the friction coefficient of the ground."""
            return float(self.values[FRICTION_NAME])

        @friction.setter
        def friction(self, value: float) -> None:
            self.values = {**self.values, FRICTION_NAME: require_known_friction(value)}

        @property
        def model_name(self) -> str:
            """Return the name of the model that is shown."""
            return str(self.values["rung"])

        @model_name.setter
        def model_name(self, value: str) -> None:
            self.values = {
                **self.values,
                "rung": check_choice("model_name", value, PAGE_MODEL_NAMES),
            }

    return Explorer


def _page_values(params: WheelParams, friction: float, model_name: str) -> dict[str, float | str]:
    """Return the values that the page exchanges: parameters, friction and model, by name."""
    numbers = {name: float(getattr(params, name)) for name in PARAMETER_DOMAINS}
    return {**numbers, FRICTION_NAME: friction, "n_legs": params.n_legs, "rung": model_name}


def _make_map(dataset: "xr.Dataset") -> dict[str, Any]:
    """Return a scan over two parameters in the format of the page's map.

    Values that are not finite become None. Of the values of several legs the smallest one is taken.
    """
    import xarray

    check_type("dataset", dataset, xarray.Dataset, "give a scan of vrw.grid over two parameters")
    axes = [
        str(name) for name in dataset.sizes if name in PARAMETER_DOMAINS and dataset.sizes[name] > 1
    ]
    if len(axes) != 2:
        raise ValueError(
            f"the dataset has the axes {', '.join(map(str, dataset.sizes))}, but a map has two "
            "parameters: give a scan of vrw.grid over two of them."
        )
    measure_values = dataset.isel(
        {name: 0 for name in dataset.sizes if name in PARAMETER_DOMAINS and name not in axes}
    )
    measures: dict[str, Any] = {}
    for name, values_of_column in measure_values.data_vars.items():
        other_dims = [dim for dim in values_of_column.dims if dim not in axes]
        if values_of_column.dtype.kind == "f" and set(axes) <= set(values_of_column.dims):
            worst_values = values_of_column.min(other_dims).transpose(*axes[::-1]).values
            measures[str(name)] = [
                [float(value) if math.isfinite(value) else None for value in row]
                for row in worst_values.tolist()
            ]
    return {
        "axes": [{"name": name, "values": measure_values[name].values.tolist()} for name in axes],
        "measures": measures,
        "outcome": measure_values["outcome"].transpose(*axes[::-1]).values.tolist(),
    }
