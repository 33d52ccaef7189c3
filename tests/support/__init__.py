"""Helpers of many tests: reference values as arrays, compiled steps, small designs."""
