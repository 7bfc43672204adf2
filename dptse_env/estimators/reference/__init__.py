"""Reference estimators by filterpy, numpy and qpsolvers, which follow the equations closely."""
