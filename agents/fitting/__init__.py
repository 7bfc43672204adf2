"""From a road file to parameters, an estimator and a query rule that suit the road."""
