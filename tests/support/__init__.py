"""What the tests are made of: servers, datasets, policies and logs, small and made up."""
