"""Plan of the effects that a scene needs: bounds, and the plan that keeps a budget."""
