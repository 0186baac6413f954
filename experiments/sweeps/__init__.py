"""Many runs: plan, launch, collect."""
