"""The study of the paper's claims: what is trained (`runs`), how that is made and measured
(`steps`), and what it says of the claims, with the page of it (`claims`)."""
