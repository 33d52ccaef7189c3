"""What many tests share: the truth as arrays, compiled steps, small designs."""
