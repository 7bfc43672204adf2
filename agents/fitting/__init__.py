"""From a road file to parameters, an estimator and a query policy that suit the road."""
