"""One insertion as it runs: the service link, the runner, its log and its report."""
