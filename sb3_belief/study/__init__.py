"""Many runs for one question: studies, and the tuning of hyper-parameters."""
