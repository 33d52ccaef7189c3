"""What a file of another format keeps of a labelled result."""

from pathlib import Path

import numpy as np
import xarray as xr


def assert_netcdf_round_trip(dataset: xr.Dataset, folder: Path) -> None:
    """Fails unless every variable and attribute comes back from a netCDF file."""
    dataset.to_netcdf(folder / "told.nc")
    reloaded = xr.open_dataset(folder / "told.nc", decode_times=False)
    for name, variable in dataset.variables.items():
        np.testing.assert_array_equal(reloaded[name].values, variable.values, str(name))
    assert set(reloaded.attrs) == set(dataset.attrs)
