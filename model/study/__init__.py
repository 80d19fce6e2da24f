"""The study of the paper's claims: what is trained (`runs`), how that is made and measured
(`stages`), what it says of the claims (`claims`), and the page of it (`report`)."""
