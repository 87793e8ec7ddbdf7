"""Tools that an operator runs beside the router."""
