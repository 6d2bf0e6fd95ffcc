"""Robot Web Services of an ABB controller, shared by its arms."""
