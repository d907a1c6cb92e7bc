//! Connected components of a set of cells, pixels or whatever else has neighbors, by flooding.

/// Connected components of a set.
pub struct Components {
    /// The component of each element, numbered from 1 in the order of their first elements; 0
    /// outside the set.
    pub label: Vec<u32>,
    /// How many elements each component has; 0 for number 0.
    pub size: Vec<usize>,
}

/// Returns the connected components of the marked elements; `around` returns the neighbors of an
/// element.
pub fn components<I: Iterator<Item = usize>>(marked: &[bool], around: impl Fn(usize) -> I) -> Components {
    let mut label = vec![0u32; marked.len()];
    let mut size: Vec<usize> = vec![0];
    let mut stack = Vec::new();
    for start in 0..marked.len() {
        if !marked[start] || label[start] != 0 {
            continue;
        }
        let id = size.len() as u32;
        size.push(0);
        label[start] = id;
        stack.push(start);
        while let Some(i) = stack.pop() {
            size[id as usize] += 1;
            // from inside, nested iterators are plain loops
            around(i).for_each(|j| {
                if marked[j] && label[j] == 0 {
                    label[j] = id;
                    stack.push(j);
                }
            });
        }
    }
    Components { label, size }
}
