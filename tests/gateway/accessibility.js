/* What tests/gateway/accessibility.py asks of a page: a function for each check, which returns what it found. */
({ CONTROLS, ...limits }) => {
  const told = (element) => {
    const id = element.id ? `#${element.id}` : "";
    const classes = [...element.classList].map((name) => `.${name}`).join("");
    const text = (element.textContent ?? "").trim().replace(/\s+/g, " ").slice(0, 40);
    return `${element.tagName.toLowerCase()}${id}${classes} "${text}"`;
  };
  const isShown = (element) => {
    if (element.closest("[inert]") || !element.checkVisibility({ visibilityProperty: true, opacityProperty: true })) return false;
    const { width, height } = element.getBoundingClientRect();
    return width > 1 && height > 1;
  };
  const texts = () => {
    const found = [];
    const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
    while (walker.nextNode()) {
      const element = walker.currentNode.parentElement;
      const isText = walker.currentNode.data.trim() && !["SCRIPT", "STYLE", "NOSCRIPT", "OPTION", "TITLE"].includes(element.tagName);
      if (isText && isShown(element)) found.push(element);
    }
    return [...new Set(found)];
  };
  const inputs = () => [...document.querySelectorAll("input:not([type=hidden]), select, textarea")].filter(isShown);
  const scale = (element) => (element instanceof SVGGraphicsElement ? element.getScreenCTM()?.a ?? 1 : 1);
  const controls = () => [...document.querySelectorAll(CONTROLS)].filter((each) => isShown(each) && !each.disabled);

  const checks = {

    contrast({ OF_TEXT, OF_LARGE }) {
      const brush = document.createElement("canvas").getContext("2d", { willReadFrequently: true });
      const parsed = (text) => {
        brush.clearRect(0, 0, 1, 1);
        brush.fillStyle = text;
        brush.fillRect(0, 0, 1, 1);
        const [r, g, b, a] = brush.getImageData(0, 0, 1, 1).data;
        return [r, g, b, a / 255];
      };
      const mix = (over, under, share) => under.slice(0, 3).map((part, i) => part * (1 - share) + over[i] * share);
      const over = (colour, under) => mix(colour, under, colour[3]);
      const luminance = (colour) => {
        const [r, g, b] = colour.map((part) => (part / 255 <= 0.04045 ? part / 255 / 12.92 : ((part / 255 + 0.055) / 1.055) ** 2.4));
        return 0.2126 * r + 0.7152 * g + 0.0722 * b;
      };
      /** What an SVG text stands on: the last shape before it whose box has its middle. */
      const shapeUnder = (text) => {
        const { x, y, width, height } = text.getBoundingClientRect();
        const shapes = [...text.ownerSVGElement.querySelectorAll("rect, circle, ellipse")].filter((shape) => {
          const box = shape.getBoundingClientRect();
          const isUnder = shape.compareDocumentPosition(text) & Node.DOCUMENT_POSITION_FOLLOWING;
          return isUnder && box.left <= x + width / 2 && box.right >= x + width / 2 && box.top <= y + height / 2 && box.bottom >= y + height / 2;
        });
        return shapes.map((shape) => getComputedStyle(shape).fill).filter((fill) => fill !== "none").at(-1) ?? "transparent";
      };
      /** Text and ground as painted, with the opacity of all that they are in. */
      const painted = (element) => {
        const chain = [];
        for (let each = element; each; each = each.parentElement) chain.unshift(each);
        const isDrawn = element instanceof SVGElement;
        const paint = (i, backdrop) => {
          const style = getComputedStyle(chain[i]);
          let ground = chain[i] instanceof SVGElement && !(chain[i] instanceof SVGSVGElement) ? backdrop : over(parsed(style.backgroundColor), backdrop);
          if (chain[i] === element && isDrawn) ground = over(parsed(shapeUnder(element)), ground);
          const [under, text] = i + 1 < chain.length ? paint(i + 1, ground) : [ground, over(parsed(isDrawn ? style.fill : style.color), ground)];
          const opacity = Number(style.opacity);
          return [mix(under, backdrop, opacity), mix(text, backdrop, opacity)];
        };
        const dark = matchMedia("(prefers-color-scheme: dark)").matches && getComputedStyle(document.documentElement).colorScheme.includes("dark");
        return paint(0, dark ? [18, 18, 18] : [255, 255, 255]);
      };
      return [...texts(), ...inputs()].filter((element) => !element.closest(":disabled")).flatMap((element) => {
        const [ground, text] = painted(element);
        const [light, dark] = [luminance(ground), luminance(text)].sort((a, b) => b - a);
        const ratio = (light + 0.05) / (dark + 0.05);
        const style = getComputedStyle(element);
        const size = parseFloat(style.fontSize) * scale(element);
        const isLarge = size >= 24 || (size >= 18.66 && Number(style.fontWeight) >= 700);
        return ratio < (isLarge ? OF_LARGE : OF_TEXT) - 0.005 ? [`${told(element)}: contrast ${ratio.toFixed(2)}`] : [];
      });
    },

    overflows() {
      const wide = document.documentElement.clientWidth;
      const isScrolled = (element) => {
        for (let each = element.parentElement; each && each !== document.body; each = each.parentElement) {
          if (["auto", "scroll", "hidden", "clip"].includes(getComputedStyle(each).overflowX)) return true;
        }
        return false;
      };
      const found = [...document.body.querySelectorAll("*")].filter((element) => isShown(element) && !isScrolled(element)).flatMap((element) => {
        const { left, right } = element.getBoundingClientRect();
        return left < -1 || right > wide + 1 ? [`${told(element)}: from ${left.toFixed(0)} to ${right.toFixed(0)} of ${wide}`] : [];
      });
      const page = document.scrollingElement.scrollWidth;
      return page > wide ? [`the page is ${page} wide on a screen of ${wide}`, ...found] : found;
    },

    cut() {
      return [...new Set(texts().flatMap((element) => [element, element.parentElement]))].filter((element) => {
        const { overflowX } = getComputedStyle(element);
        return ["hidden", "clip"].includes(overflowX) && element.scrollWidth > element.clientWidth + 1 && element !== document.body;
      }).map((element) => `${told(element)}: ${element.scrollWidth} wide in ${element.clientWidth}`);
    },

    smallTexts({ LEAST }) {
      return [...texts(), ...inputs()].flatMap((element) => {
        const size = parseFloat(getComputedStyle(element).fontSize) * scale(element);
        return size < LEAST - 0.01 ? [`${told(element)}: ${size.toFixed(1)} px`] : [];
      });
    },

    smallTargets({ LEAST }) {
      const isInText = (element) => getComputedStyle(element).display === "inline" && element.matches("a");
      const boxes = controls().filter((each) => !isInText(each)).map((element) => [element, element.getBoundingClientRect()]);
      const isSmall = ({ width, height }) => width < LEAST - 0.5 || height < LEAST - 0.5;
      const middle = ({ x, y, width, height }) => [x + width / 2, y + height / 2];
      const gap = ([x, y], { left, right, top, bottom }) => Math.hypot(Math.max(left - x, 0, x - right), Math.max(top - y, 0, y - bottom));
      return boxes.filter(([, box]) => isSmall(box)).flatMap(([element, box]) => {
        const near = boxes.filter(([other]) => other !== element && !other.contains(element) && !element.contains(other)).some(([, other]) => {
          const [a, b] = [middle(box), middle(other)];
          return isSmall(other) ? Math.hypot(a[0] - b[0], a[1] - b[1]) < LEAST - 0.5 : gap(a, other) < LEAST / 2 - 0.5;
        });
        return near ? [`${told(element)}: ${box.width.toFixed(0)} x ${box.height.toFixed(0)}`] : [];
      });
    },

    focus() {
      const style = (element) => {
        const { outlineStyle, outlineWidth, boxShadow, borderColor, backgroundColor } = getComputedStyle(element);
        return JSON.stringify([outlineStyle === "none" ? "" : outlineWidth, boxShadow, borderColor, backgroundColor]);
      };
      const before = document.activeElement;
      const found = controls().filter((element) => element.tabIndex >= 0).flatMap((element) => {
        before?.blur?.();
        const unfocused = style(element);
        element.focus({ focusVisible: true, preventScroll: true });
        if (document.activeElement !== element) return [`${told(element)}: does not take the focus`];
        return style(element) === unfocused ? [`${told(element)}: the focus does not show`] : [];
      });
      document.activeElement?.blur?.();
      before?.focus?.();
      return found;
    },
  };
  return checks[limits.CHECK](limits);
}
