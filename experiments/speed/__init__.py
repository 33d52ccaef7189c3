"""What steps, cycles, scans and compiling cost, beside others and beside before."""
