"""Links: what is lost on the way, as pure processes and as a service."""
