"""Which effects a scene calls for: bounds and the plan that keeps a budget."""
