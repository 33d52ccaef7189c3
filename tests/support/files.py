"""Check that labeled results keep their content in files of another format."""

from pathlib import Path

import numpy as np
import xarray as xr


def assert_netcdf_round_trip(dataset: xr.Dataset, folder: Path) -> None:
    """Fail unless a netCDF file returns every variable and attribute."""
    dataset.to_netcdf(folder / "told.nc")
    reloaded = xr.open_dataset(folder / "told.nc", decode_times=False)
    for name, variable in dataset.variables.items():
        np.testing.assert_array_equal(reloaded[name].values, variable.values, str(name))
    assert set(reloaded.attrs) == set(dataset.attrs)
