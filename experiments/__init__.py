"""Scripts with a claim on line one each: `python -m experiments.FOLDER.NAME` from the root."""
