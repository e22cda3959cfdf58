"""Several unmodified SB3 models learn in one joint environment, step by step together."""
