// a click on a figure shows it as large as the window; another click, or Escape, closes it
const dialog = document.createElement("dialog");
dialog.className = "figure";
dialog.onclick = () => dialog.close();
document.body.append(dialog);
const enlarge = (image) => {
  dialog.replaceChildren(Object.assign(new Image(), { src: image.src, alt: image.alt }));
  dialog.showModal();
};
for (const image of document.querySelectorAll(".md-content img")) {
  if (image.closest("a")) continue;
  image.tabIndex = 0;
  image.title = "Enlarge";
  image.onclick = () => enlarge(image);
  image.onkeydown = (event) => event.key === "Enter" && enlarge(image);
}
// commands wrap between words alone: a browser would also break an option after a hyphen
for (const code of document.querySelectorAll(".md-content table code, .md-content pre > code")) {
  if (code.children.length) continue;
  const parts = code.textContent.split(/(\s+)/).map((text) =>
    /\S/.test(text) ? Object.assign(document.createElement("span"), { textContent: text }) : text);
  code.replaceChildren(...parts);
}
// where the site holds the page itself, it stands in for its picture
for (const still of document.querySelectorAll("img[src$='look/page.webp'], img[src$='look/movers.webp']")) {
  const page = still.src.replace(/webp$/, "html");
  fetch(page, { method: "HEAD" }).then(({ ok }) => {
    const frame = document.createElement("iframe");
    if (ok) still.replaceWith(Object.assign(frame, { src: page, loading: "lazy", title: still.alt }));
  }).catch(() => {});
}
