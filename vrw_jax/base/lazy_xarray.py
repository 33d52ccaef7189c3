"""The library xarray, imported on first use. All labeled results are its datasets."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import xarray as xarray
else:

    class _LazyXarray:
        """Proxy for xarray, which is imported when an attribute is first read, because its import
        takes long.
        """

        def __getattr__(self, attribute_name: str) -> Any:
            import xarray

            return getattr(xarray, attribute_name)

    xarray = _LazyXarray()
