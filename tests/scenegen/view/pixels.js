() => {
  const [canvas, count] = [document.querySelector("#scene"), +document.body.dataset.views];
  const wide = 2 * Math.floor(canvas.clientWidth / count / 2);
  return Array.from({ length: count }, (_, n) => {
    const copy = Object.assign(document.createElement("canvas"), { width: wide, height: 700 });
    copy.getContext("2d").drawImage(canvas, -n * wide, 0);
    return copy.toDataURL();
  });
}
