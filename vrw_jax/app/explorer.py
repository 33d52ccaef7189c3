"""Access to the page docs/wheel.html: its address, and a notebook widget that shows it."""

import functools
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import urlencode

import numpy as np

from vrw_jax.base.checks import check_choice, check_int, check_type, require_untraced_arguments
from vrw_jax.models.ladder import list_model_config_names
from vrw_jax.wheel.params import (
    FRICTION_NAME,
    PARAMETER_DOMAINS,
    WheelParams,
    require_known_friction,
)

if TYPE_CHECKING:
    import xarray as xr

PAGE_MODEL_NAMES = list_model_config_names("explore")
"""Names of the models with which the page can compute steps."""

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
"""JavaScript code of the widget. It shows the page in a frame and exchanges changed values with the
page.
"""


def find_wheel_page() -> Path:
    """Return the path of the page docs/wheel.html, which is in the installed package or next to
    it.
    """
    package_folder = Path(__file__).parents[1]
    candidate_paths = (package_folder / "wheel.html", package_folder.parent / "docs/wheel.html")
    return next(filter(Path.exists, candidate_paths))


def make_page_address(params: WheelParams, model_name: str = PAGE_MODEL_NAMES[0]) -> str:
    """Return the address at which the page docs/wheel.html shows this wheel.

    The address contains the parameters of the wheel that differ from their default values.
    """
    check_choice("model_name", model_name, PAGE_MODEL_NAMES)
    default_values = _make_page_values(WheelParams(), 1.0, PAGE_MODEL_NAMES[0])
    changed_values = {
        input_name: input_value
        for input_name, input_value in _make_page_values(params, 1.0, model_name).items()
        if input_value != default_values[input_name]
    }
    page_fragment = f"#{urlencode(changed_values)}" if changed_values else ""
    return find_wheel_page().as_uri() + page_fragment


def explore(
    params: WheelParams | None = None,
    *,
    friction: float = 1.0,
    model_name: str = "viscoelastic",
    dataset: "xr.Dataset | None" = None,
    height: int = 900,
) -> Any:
    """Return an interactive widget that shows the wheel in Jupyter, JupyterLab, VS Code or marimo.

    The widget shows the page docs/wheel.html, which computes steps in the browser as this library
    does. The property `params` of the widget is the displayed wheel. An assignment to `params`
    moves the sliders. The same holds for the properties `friction` and `model_name`. The property
    `measures` contains the measures of the step, by the names in `vrw.MEASURES`. The package
    anywidget is required: `pip install 'vrw-jax[explore]'`.

    Args:
        params: wheel that is displayed first; by default that of Table 1 of the paper.
        friction: friction coefficient of the ground, for unilateral contact and for margins.
        model_name: "viscoelastic", "rigid" for rigid legs, or "unilateral" for unilateral contact.
        dataset: dataset that `vrw.scan` returns for a grid of two parameters; the page shows it as
            a map.
        height: height of the widget, in pixels.

    Returns:
        The widget, which a notebook displays as the result of a cell.

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
    require_untraced_arguments("vrw.explore", "it shows one known wheel", params)
    params.require_single_wheel("show one after the other")
    return _make_widget_class()(
        page=find_wheel_page().read_text(encoding="utf-8"),
        values=_make_page_values(
            params,
            require_known_friction(friction),
            check_choice("model_name", model_name, PAGE_MODEL_NAMES),
        ),
        map={} if dataset is None else _make_page_map(dataset),
        height=check_int("height", height),
    )


@functools.cache
def _make_widget_class() -> type:
    """Return the class of the widget. The class is created on first use, because anywidget is
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
        """Widget that shows the page in a frame and exchanges values with the page.

        The values are the parameters of the wheel and the measures of the step.
        """

        _esm = WIDGET_JAVASCRIPT
        page = traitlets.Unicode().tag(sync=True)
        values = traitlets.Dict().tag(sync=True)
        measures = traitlets.Dict().tag(sync=True)
        map = traitlets.Dict().tag(sync=True)
        height = traitlets.Int().tag(sync=True)

        @property
        def params(self) -> WheelParams:
            """Return the displayed wheel."""
            parameter_values = {
                parameter_name: float(self.values[parameter_name])
                for parameter_name in PARAMETER_DOMAINS
            }
            return WheelParams(**parameter_values, n_legs=int(self.values["n_legs"]))

        @params.setter
        def params(self, params: WheelParams) -> None:
            self.values = _make_page_values(params, self.friction, self.model_name)

        @property
        def friction(self) -> float:
            """Return the friction coefficient of the ground."""
            return float(self.values[FRICTION_NAME])

        @friction.setter
        def friction(self, friction_coefficient: float) -> None:
            checked_friction = require_known_friction(friction_coefficient)
            self.values = self.values | {FRICTION_NAME: checked_friction}

        @property
        def model_name(self) -> str:
            """Return the name of the displayed model."""
            return str(self.values["rung"])

        @model_name.setter
        def model_name(self, value: str) -> None:
            checked_name = check_choice("model_name", value, PAGE_MODEL_NAMES)
            self.values = self.values | {"rung": checked_name}

    return Explorer


def _make_page_values(
    params: WheelParams, friction: float, model_name: str
) -> dict[str, float | str]:
    parameter_values = {
        parameter_name: float(getattr(params, parameter_name))
        for parameter_name in PARAMETER_DOMAINS
    }
    return {
        **parameter_values,
        FRICTION_NAME: friction,
        "n_legs": params.n_legs,
        "rung": model_name,
    }


def _make_page_map(dataset: "xr.Dataset") -> dict[str, Any]:
    """Return a scan over two parameters in the format that the page needs for its map.

    Values that are not finite become None. A measure with one value per leg is replaced by the
    smallest of these values.
    """
    import xarray

    check_type("dataset", dataset, xarray.Dataset, "give a scan of vrw.grid over two parameters")
    map_axis_names = [
        str(dimension_name)
        for dimension_name in dataset.sizes
        if dimension_name in PARAMETER_DOMAINS and dataset.sizes[dimension_name] > 1
    ]
    if len(map_axis_names) != 2:
        raise ValueError(
            f"the dataset has the axes {', '.join(map(str, dataset.sizes))}, but a map has two "
            "parameters: give a scan of vrw.grid over two of them."
        )
    map_dataset = dataset.squeeze().transpose(*map_axis_names[::-1], ...)
    map_measures = {}
    for variable_name, measure_array in map_dataset.data_vars.items():
        if measure_array.dtype.kind == "f" and set(map_axis_names) <= set(measure_array.dims):
            min_values_over_legs = measure_array.min(measure_array.dims[2:]).values
            map_measures[str(variable_name)] = np.where(
                np.isfinite(min_values_over_legs), min_values_over_legs, np.array(None)
            ).tolist()
    return {
        "axes": [
            {"name": map_axis_name, "values": dataset[map_axis_name].values.tolist()}
            for map_axis_name in map_axis_names
        ],
        "measures": map_measures,
        "outcome": map_dataset["outcome"].values.tolist(),
    }
