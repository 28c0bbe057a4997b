"""Calibration: each fit takes data of validation objects and returns the parameters that `retrieval.model` applies."""
