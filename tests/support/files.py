"""What a file of another format keeps of a labelled result."""

from pathlib import Path

import numpy as np
import xarray as xr


def kept_by_netcdf(dataset: xr.Dataset, folder: Path) -> None:
    """Fails unless every variable and attribute comes back from a netCDF file."""
    dataset.to_netcdf(folder / "told.nc")
    back = xr.open_dataset(folder / "told.nc", decode_times=False)
    for name, variable in dataset.variables.items():
        np.testing.assert_array_equal(back[name].values, variable.values, str(name))
    assert set(back.attrs) == set(dataset.attrs)
